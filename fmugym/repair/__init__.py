"""Libraries that FMUs lack on this machine, and the compiler that builds them."""

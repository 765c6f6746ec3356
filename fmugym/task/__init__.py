"""Parts of an environment: the FMU's interface, spaces, values by name, and episodes."""

"""What a task is made of: the FMU's interface, spaces, values by name, and episodes."""

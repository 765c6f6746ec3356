"""The first trial of an FMU, in a process that it may crash, and the conclusions drawn from it."""

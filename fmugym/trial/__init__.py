"""The first meeting with an FMU, in a process that may die of it, and what follows from it."""

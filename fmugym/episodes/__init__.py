"""Episodes of a task: who acts, what comes of it, and files about it."""

"""Episodes of a task: players, scores, and files."""

"""The check whether hooks work on arrays, their results there, and their programs."""

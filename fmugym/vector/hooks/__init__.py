"""Whether hooks work on arrays, and hooks turned into programs."""

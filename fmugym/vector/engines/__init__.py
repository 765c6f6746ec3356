"""Three ways to play N environments: by programs, with hooks on arrays, or one by one."""

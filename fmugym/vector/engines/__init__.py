"""Three ways to play N environments: compiled, on arrays, or one by one."""

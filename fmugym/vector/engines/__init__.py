"""Three ways to play N environments: with compiled hooks, on arrays, or one by one."""

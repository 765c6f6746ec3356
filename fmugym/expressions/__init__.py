"""The one language that is compiled: the text of an expression, its graph, and its program."""

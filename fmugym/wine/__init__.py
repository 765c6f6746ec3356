"""Wine, which runs Windows libraries on Linux, and the worker program that loads them there."""

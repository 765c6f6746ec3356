"""The three versions of FMI behind one interface. Only this package knows their call sequences.

A ``Library`` is the shared library of one FMU, loaded once through FMPy. An ``Instance`` is one
simulation in it.
"""

"""The three versions of FMI behind one interface: the only room that knows their call order.

A ``Library`` is the shared library of one FMU, loaded once through FMPy. An ``Instance`` is one
simulation in it.
"""

"""Systems: several FMUs that run as one.

``plan`` says what a master executes, ``fmu`` makes a system look like an FMU.
"""

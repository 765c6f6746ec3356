"""System structures by SSP 1.0: reading archives.

``elements`` holds what an SSD file says, ``parameters`` its parameter sets, ``flat`` makes
one level of nested systems, and ``archives`` reads the arguments of an ``FMUSystem``.
The standard: Modelica Association, System Structure and Parameterization 1.0, 2019.
"""

"""System structures by SSP 1.0: reading and writing archives.

``elements`` holds what an SSD file says, ``parameters`` its parameter sets, ``flattening`` makes
one level of nested systems, ``reading`` makes an ``FMUSystem``, and ``writing`` an archive.
The standard: Modelica Association, System Structure and Parameterization 1.0, 2019.
"""

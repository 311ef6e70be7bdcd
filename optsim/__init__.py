"""optsim: validate an adaptive pixel-wise coded-exposure camera before its hardware exists."""

__version__ = "0.1.0"

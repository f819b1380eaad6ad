"""CABLE-RPC: region-of-interest perception streaming, measured in true bytes, milliseconds and quality."""

__version__ = "0.1.0"

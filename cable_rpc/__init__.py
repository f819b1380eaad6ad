"""CABLE-RPC: region-of-interest perception streaming, measured in true bytes, milliseconds and quality."""

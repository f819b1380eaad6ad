"""Bitrate against quality over a grid of settings: cells, where they are kept, what runs them."""

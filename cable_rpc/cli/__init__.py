"""The `cable-rpc` command: thin commands that parse, call and print."""

from cable_rpc.cli.app import app, main

__all__ = ["app", "main"]

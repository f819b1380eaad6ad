"""`python -m cable_rpc`."""

from cable_rpc.cli import main

main()

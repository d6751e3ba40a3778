"""`python -m slimsfm`."""

from slimsfm.cli import main

main()

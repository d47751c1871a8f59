"""`python -m whitefurnace`."""

from whitefurnace.cli import main

main()

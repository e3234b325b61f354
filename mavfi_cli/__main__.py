"""`python -m mavfi_cli` is `mavfi`."""

from mavfi_cli.cli import main

main()

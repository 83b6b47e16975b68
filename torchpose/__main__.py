"""`python -m torchpose` is the command `torchpose`."""

from torchpose.cli import main

if __name__ == "__main__":
    raise SystemExit(main())

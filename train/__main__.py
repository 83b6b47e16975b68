"""Run `python -m train`: fit, select, predict."""

from train.cli import main

if __name__ == "__main__":
    raise SystemExit(main())

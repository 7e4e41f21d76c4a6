"""Entry point of `st`; Ctrl-C ends it without a traceback, even while modules are being imported."""

import signal


def main() -> None:
    handler = signal.signal(signal.SIGINT, signal.SIG_DFL)
    from .cli import main as run

    signal.signal(signal.SIGINT, handler)
    run()


if __name__ == "__main__":
    main()

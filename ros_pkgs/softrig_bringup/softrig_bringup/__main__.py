import signal
import sys

usual = signal.getsignal(signal.SIGINT)
if usual is signal.default_int_handler:  # not ignored, as in the background of a script
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C among the imports ends the process without a word

from .cli import main  # noqa: E402

signal.signal(signal.SIGINT, usual)
status = main()
signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done, nothing is left to be interrupted
sys.exit(status)

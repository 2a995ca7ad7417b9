import signal
import sys

usual = signal.getsignal(signal.SIGINT)
if usual is signal.default_int_handler:  # not ignored, as in the background of a script
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C among the imports ends the process without a word

from softrig_core.guard import end_within  # noqa: E402

from .cli import main  # noqa: E402

PATIENCE = 2.0  # s for threads of a user's code, which Python waits for

signal.signal(signal.SIGINT, usual)
status = main()
signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done, nothing is left to be interrupted
end_within(PATIENCE, status)
sys.exit(status)

import signal
import sys

usual = signal.getsignal(signal.SIGINT)
if usual is signal.default_int_handler:  # in the background of a script SIGINT is ignored
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the imports ends the process without a traceback

from softrig_core.guard import end_within  # noqa: E402

from .cli import main  # noqa: E402

PATIENCE = 2.0  # s for threads of a user's code, which Python waits for

signal.signal(signal.SIGINT, usual)
status = main()
signal.signal(signal.SIGINT, signal.SIG_IGN)  # everything is done, so an interrupt would change nothing
end_within(PATIENCE, status)
sys.exit(status)

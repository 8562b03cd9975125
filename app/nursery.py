"""Imported last by the process of which the others are forks (`processes`): it outlives what ends them.

Only to be imported there.
"""

import gc
import signal

from app.processes import show_as

show_as("hemislam-forks")
signal.signal(signal.SIGTERM, signal.SIG_IGN)  # sent to a whole group; it ends with the server, and tells who died
gc.collect()
gc.freeze()  # the collector would write to what is imported, and each process have it to itself then

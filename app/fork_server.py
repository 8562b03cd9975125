"""What the fork server imports last (`app.child`). Not to be imported anywhere else."""

import gc

from app.child import show_as

show_as("hemislam-forks")
gc.collect()
gc.freeze()  # else each child's garbage collector writes to the shared pages, and the child gets its own copy of them

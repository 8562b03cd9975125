"""What the fork server imports first (`app.child`). Not to be imported anywhere else."""

import gc

from app.child import show_as

show_as("hemislam-forks")
gc.disable()  # looking for garbage in what is being imported takes a sixth of the time

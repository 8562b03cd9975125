"""The command line: one module per command, imported by `app.__main__`, which holds the three short ones.

`options` has the options that commands share, `run` also the steps that `replay` and `export` repeat.
"""

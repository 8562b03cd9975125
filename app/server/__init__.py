"""The engine's process, its mailbox, and the one public port."""

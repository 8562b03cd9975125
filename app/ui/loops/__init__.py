"""Loops in the page: edges in the scene, the ledger, all there is on one of them, and editing them."""

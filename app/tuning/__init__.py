"""Search for the parameters that fit a sensor and a place.

`space` says what may vary, `objectives` what is wanted, `tune` searches, `report` writes the result; `process` does all
of it for the page.
"""

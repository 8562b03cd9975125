"""Search for the parameters that suit a sensor and a place.

`space` declares what may vary, `objectives` what to optimise; `tune` searches, `report` writes the result; `process`
does all of this for the page.
"""

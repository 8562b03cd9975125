"""Compare runs with the truth and with each other: variants, errors, times, map sharpness, reports.

`evaluate` plans jobs, `runner` or `cluster` runs them (`run_job`), `measured` reads their files back, `truth` and
`truth_match` provide true poses, and `report` writes `tables`, `figures` and `findings`.
"""

"""The recording doctor: what a recording holds, what was corrected, and what only the user can settle."""

from app.sensors.findings import Finding as Finding

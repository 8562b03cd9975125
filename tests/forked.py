"""What the processes that tests fork import: those of the engine, of jobs, of searches, and of a live sensor."""

import app.evaluation.run_job
import app.evaluation.runner
import app.sensors.live.process
import app.server.engine_process
import app.slam.loops.service
import app.slam.warmup
import app.tuning.process  # noqa: F401

"""Imports for the processes that tests fork: of the engine, of jobs, of searches, and of a live sensor."""

import app.evaluation.run_job
import app.evaluation.runner
import app.sensors.live.process
import app.server.engine_process
import app.slam.loops.service
import app.slam.warmup
import app.tuning.process

app.slam.loops.service.warm_up()  # on one thread; forks have the kernels

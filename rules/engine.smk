"""What the workflow asks of its engine: less work beside the jobs."""

import atexit
import gc

# A job graph is many objects that live to the end: looking for garbage among them, which the interpreter
# does once more when it ends, took a fifth of a dry run.
gc.disable()
atexit.register(gc.freeze)


def calm_engine():
    """For a run, once its jobs are known."""
    # The graph is not garbage; what jobs leave is looked for among what came after it, and soon: rare
    # searches let it pile up by 4 kB a job.
    gc.freeze()
    gc.set_threshold(5_000, 10, 10)
    gc.enable()
    # With a limit of jobs per second, which there is unless it is asked for another, every round of the
    # scheduler starts a timer that starts one more: rounds per second grow with the jobs that are done.
    limit = getattr(workflow.scheduler, "job_rate_limiter", None)
    if limit and (limit.max_jobs, limit.timespan) == (100, 1):
        workflow.scheduler.job_rate_limiter = None

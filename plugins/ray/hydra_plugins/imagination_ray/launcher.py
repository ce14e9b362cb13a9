"""Hydra launcher for Ray: each job of a sweep is a task in a separate process, retried if its worker dies.

It replaces hydra-ray-launcher 1.2.1, which requires cloudpickle < 3, in conflict with current versions of other
packages, and neither retries jobs nor reports which failed. Hydra imports this module at each start, so Ray is
imported lazily.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.core.utils import JobReturn, JobStatus, filter_overrides, run_job, setup_globals
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, open_dict

from imagination.utils.errors import UserError, require_extra


class RayLauncher(Launcher):
    """Launcher that runs the jobs of a sweep as Ray tasks.

    Args:
        address: address of a running cluster; "local" starts one on this machine for the duration of the sweep.
        num_cpus, num_gpus: CPU cores and GPUs reserved by a job; Ray sets its number of threads to `num_cpus`.
        max_retries: number of retries of a job whose worker was killed.
    """

    def __init__(self, address: str, num_cpus: float, num_gpus: float, max_retries: int) -> None:
        self.address = address
        self.options: dict[str, Any] = {
            "num_cpus": num_cpus,
            "num_gpus": num_gpus,
            "max_retries": max_retries,
        }

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        self.context, self.task, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run all jobs and wait for them.

        Raises:
            UserError: if Ray is not installed; after all jobs have ended, if some failed.
        """
        require_extra("ray", "ray")
        os.environ.setdefault("RAY_DEDUP_LOGS", "0")  # else equal lines of several jobs are logged once
        import ray

        ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers cannot import from plugins/
        setup_globals()
        started = not ray.is_initialized()
        if started:
            ray.init(address=self.address, include_dashboard=False if self.address == "local" else None)
        try:
            # max_calls=1: a new process for each job, without the state of earlier ones
            remote = ray.remote(max_calls=1, **self.options)(run_sweep_job)
            shared = ray.put((self.context, self.config, self.task, Singleton.get_state(), os.getcwd()))
            tasks = [
                remote.remote(shared, list(overrides), initial_job_idx + number)
                for number, overrides in enumerate(job_overrides)
            ]
            results = [
                wait_for_job(task, overrides) for task, overrides in zip(tasks, job_overrides, strict=True)
            ]
        finally:
            if started:
                ray.shutdown()
        failed = [
            f"{number} ({' '.join(filter_overrides(list(overrides)))})"
            for number, (overrides, result) in enumerate(zip(job_overrides, results, strict=True))
            if result.status != JobStatus.COMPLETED
        ]
        if failed:
            raise UserError(
                f"sweep: {len(failed)} of {len(results)} jobs failed: {', '.join(failed)}; their messages are above. "
                f"Run the unfinished jobs with the same command and hydra.sweep.dir={self.config.hydra.sweep.dir}"
            )
        return results


def run_sweep_job(shared: Any, overrides: list[str], number: int) -> JobReturn:
    """Run one job in a Ray worker, as the launchers of Hydra do."""
    context, config, task, singletons, folder = shared
    os.chdir(folder)
    os.environ.pop("SLURM_STEP_NUM_TASKS", None)  # set by the srun that started Ray; jobs are not its tasks
    setup_globals()
    Singleton.set_state(singletons)
    job_config = context.config_loader.load_sweep_config(config, overrides)
    with open_dict(job_config):
        job_config.hydra.job.id = f"{job_config.hydra.job.name}_{number}"
        job_config.hydra.job.num = number
    HydraConfig.instance().set_config(job_config)
    try:
        return run_job(
            hydra_context=context,
            task_function=task,
            config=job_config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )
    except SystemExit as stop:  # a reported user error; Ray would take it for a killed worker and retry
        return failure(overrides, UserError(f"exit code {stop.code}"))


def wait_for_job(task: Any, overrides: Sequence[str]) -> JobReturn:
    """Wait for a job; it has failed if it returns no result, e.g. if its worker was killed too often."""
    import ray

    try:
        result: JobReturn = ray.get(task)
        return result
    except ray.exceptions.RayError as error:
        print(f"A job ({' '.join(filter_overrides(overrides))}) is lost: {error}", file=sys.stderr)
        return failure(overrides, error)


def failure(overrides: Sequence[str], error: Exception) -> JobReturn:
    """Return the result of a failed job."""
    return JobReturn(overrides=overrides, status=JobStatus.FAILED, _return_value=error)

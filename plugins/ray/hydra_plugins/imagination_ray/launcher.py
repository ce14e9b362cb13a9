"""Hydra's launcher for Ray: each member of a sweep is a task in a process of its own; one whose worker dies is retried.

Ours because Hydra's own (hydra-ray-launcher 1.2.1) asks for cloudpickle below 3, which does not go with current
versions of other packages, and neither retries nor tells which members failed. Hydra imports this module at each start,
so Ray is imported late.
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
    """Runs the members of a sweep as Ray tasks.

    Args:
        address: of a running cluster; "local" starts one on this machine, for as long as the sweep takes.
        num_cpus, num_gpus: that a member reserves; Ray makes the former its number of threads.
        max_retries: of a member whose worker was killed.
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
        """Run all members and wait for them.

        Raises:
            UserError: if Ray is not installed, or members failed, once all others are done.
        """
        require_extra("ray", "ray")
        os.environ.setdefault("RAY_DEDUP_LOGS", "0")  # else rows that two tables share are told once
        import ray

        ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers do not look in plugins/
        setup_globals()
        started = not ray.is_initialized()
        if started:
            ray.init(address=self.address, include_dashboard=False if self.address == "local" else None)
        try:
            # a process for each member, so that none inherits another's state
            remote = ray.remote(max_calls=1, **self.options)(run_sweep_job)
            shared = ray.put((self.context, self.config, self.task, Singleton.get_state(), os.getcwd()))
            tasks = [
                remote.remote(shared, list(overrides), initial_job_idx + number)
                for number, overrides in enumerate(job_overrides)
            ]
            results = [outcome(task, words) for task, words in zip(tasks, job_overrides, strict=True)]
        finally:
            if started:
                ray.shutdown()
        told = [
            f"{number} ({' '.join(filter_overrides(list(overrides)))})"
            for number, (overrides, result) in enumerate(zip(job_overrides, results, strict=True))
            if result.status != JobStatus.COMPLETED
        ]
        if told:
            raise UserError(
                f"sweep: {len(told)} of {len(results)} members failed: {', '.join(told)}; their messages are above. "
                f"Run what is not done: the same command with sweep_dir={self.config.hydra.sweep.dir}"
            )
        return results


def run_sweep_job(shared: Any, overrides: list[str], number: int) -> JobReturn:
    """Run one member in a Ray worker, as Hydra's own launchers do."""
    context, config, task, singletons, folder = shared
    os.chdir(folder)
    os.environ.pop("SLURM_STEP_NUM_TASKS", None)  # of the srun that started Ray: members are not its tasks
    setup_globals()
    Singleton.set_state(singletons)
    member = context.config_loader.load_sweep_config(config, overrides)
    with open_dict(member):
        member.hydra.job.id = f"{member.hydra.job.name}_{number}"
        member.hydra.job.num = number
    HydraConfig.instance().set_config(member)
    try:
        return run_job(
            hydra_context=context,
            task_function=task,
            config=member,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )
    except SystemExit as stop:  # a mistake that was told; Ray would take it for a killed worker and try again
        return failure(overrides, UserError(f"it ended with code {stop.code}"))


def outcome(task: Any, overrides: Sequence[str]) -> JobReturn:
    """Wait for a member; one that gives no result, as when its worker was killed once too often, has failed."""
    import ray

    try:
        result: JobReturn = ray.get(task)
        return result
    except ray.exceptions.RayError as error:
        print(f"A member ({' '.join(filter_overrides(overrides))}) is lost: {error}", file=sys.stderr)
        return failure(overrides, error)


def failure(overrides: Sequence[str], error: Exception) -> JobReturn:
    """What Hydra gets of a member that failed."""
    return JobReturn(overrides=overrides, status=JobStatus.FAILED, _return_value=error)

"""Makes Hydra's Slurm launcher wait for every job (`hydra/launcher=slurm`); read at each start, so
nothing heavy."""

from collections.abc import Sequence
from contextlib import suppress

from hydra.core.utils import JobReturn

with suppress(ImportError):  # the extra `slurm` is not installed
    from hydra_plugins.hydra_submitit_launcher.submitit_launcher import SlurmLauncher as Original

    class SlurmLauncher(Original):
        """The original raises at the first job that Slurm cancelled or lost, and forgets those
        after it."""

        def launch(
            self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
        ) -> Sequence[JobReturn]:
            from ssm_study.engine.launcher import launch_sweep
            from ssm_study.engine.slurm import Slurm

            return launch_sweep(
                Slurm(self), self, [list(words) for words in job_overrides], initial_job_idx
            )

"""Steps of EM over states drawn anew in every step, in new processes, with their time and memory.

`benchmarks.speed.streamed_em` makes tables of them.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from statistics import median
from typing import Any, NamedTuple

import torch

from benchmarks.speed._memory import MB, forget_peak, peak_resident, resident, return_free_memory
from benchmarks.speed._timing import limit_threads
from torchpose.learning._blocks import Share
from torchpose.learning._samplers import ArmSource, SampleSource, TensorSource
from torchpose.learning._streamed_em import StreamedEM

POSES = 60_000
CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


class Job(NamedTuple):
    """What a worker has to do: some steps over some states, as process `rank` of `size`."""

    samples: int
    components: int
    steps: int
    data: str | None = None
    threads: int = 1
    rank: int = 0
    size: int = 1
    store: str = ""


class Run(NamedTuple):
    """Results of all processes of a job."""

    job: Job
    found: list[dict[str, Any]]

    @property
    def step(self) -> float:
        """Return the median time of a step; all processes end it together."""
        return median(self.found[0]["steps"])

    @property
    def best(self) -> float:
        """Return the smallest time of a step."""
        return min(self.found[0]["steps"])

    @property
    def cpu(self) -> float:
        """Return the CPU time of a step, over all processes."""
        return sum(result["cpu"] for result in self.found) / self.job.steps

    @property
    def peak(self) -> float:
        """Return the peak of the resident memory of the largest process, MB."""
        return max(result["peak"] for result in self.found) / MB

    @property
    def log_likelihood(self) -> float:
        """Return the mean log-likelihood before the last step."""
        return self.found[0]["log_likelihood"]

    @property
    def name(self) -> str:
        """Return the number of processes and the threads of each."""
        return f"{self.job.size} x {self.job.threads}"


def work(job: Job) -> dict[str, Any]:
    """Take the steps of a job; seconds of each, memory, and the log-likelihood before the last."""
    share = join(job)
    began, source = time.perf_counter(), make_source(job)
    em = StreamedEM.start(source, job.components)
    started = time.perf_counter() - began
    em.accumulate(TensorSource(source.block(0).states))  # loads libraries
    return_free_memory()
    before = resident()
    forget_peak()
    share.total(torch.zeros(1))
    steps, cpu = [], time.process_time()
    for _ in range(job.steps):
        began = time.perf_counter()
        value = em.maximise(em.accumulate(source, share))
        steps.append(time.perf_counter() - began)
    cpu = time.process_time() - cpu
    peak = peak_resident()
    drawing = time.process_time()
    blocks = min(source.n_blocks, 400)
    count = sum(len(source.block(block).states) for block in range(blocks))
    drawing = (time.process_time() - drawing) * source.n_samples / count
    times = {"start": started, "steps": steps, "cpu": cpu, "drawing": drawing}
    return {**times, "before": before, "peak": peak, "log_likelihood": value}


def join(job: Job) -> Share:
    """Return the group of processes."""
    if job.size == 1:
        return Share()
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{job.store}", rank=job.rank, world_size=job.size
    )
    return Share.of_processes()


def make_source(job: Job) -> SampleSource:
    """Return states of left arms from random viewpoints, drawn whenever they are asked for."""
    from torchpose.learning import TRAINING_VIEWS

    matrix = torch.tensor([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
    if job.data is not None:
        from torchpose.io import read_recordings
        from torchpose.learning._training import arm_sources, collect_poses

        poses = collect_poses(read_recordings([job.data]))
        return arm_sources(poses, matrix.double(), n_samples=job.samples).left
    arms = made_up_arms()
    return ArmSource(
        matrix=matrix.double(), views=TRAINING_VIEWS, rotation_order="zxy", n_samples=job.samples,
        seed=0, fresh=False, arms=arms, weight=torch.ones(len(arms), dtype=torch.float64),
    )  # fmt: skip


def made_up_arms() -> torch.Tensor:
    """Hand, elbow, shoulder, head and neck of arms that go from one of 40 gestures to the next."""
    g = torch.Generator().manual_seed(0)
    gestures = torch.randn(40, 2, 3, generator=g, dtype=torch.float64)
    gestures = gestures / gestures.norm(dim=-1, keepdim=True)
    way = torch.linspace(0, 39, POSES, dtype=torch.float64)
    low, between = way.long().clamp_max(38), (way % 1)[:, None, None]
    limbs = (1 - between) * gestures[low] + between * gestures[low + 1]
    limbs = limbs + 0.1 * torch.randn(limbs.shape, generator=g, dtype=torch.float64)
    limbs = limbs / limbs.norm(dim=-1, keepdim=True)
    trunk = torch.tensor([[0.18, 0.08, 0.0], [0.0, -0.2, 0.02], [0.0, 0.0, 0.0]]).double()
    trunk = trunk + 0.01 * torch.randn(POSES, 3, 3, generator=g, dtype=torch.float64)
    elbow = trunk[:, 0] + 0.28 * limbs[:, 0]
    hand = elbow + 0.26 * limbs[:, 1]
    return torch.cat([torch.stack([hand, elbow], 1), trunk], 1)


def in_processes(job: Job, quick: bool) -> Run:
    """Call `work` in `job.size` new processes, each with cores of its own where there are enough.

    Args:
        job: what to do. quick: whether one process may be this one, whose peak means nothing.
    """
    if quick and job.size == 1:
        return Run(job, [work(job)])
    with tempfile.TemporaryDirectory() as folder:
        started = []
        for rank in range(job.size):
            own = job._replace(rank=rank, store=f"{folder}/store")
            command = [sys.executable, __file__, json.dumps(own._asdict())]
            started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            if len(CORES) >= job.size * job.threads:
                own_cores = CORES[rank * job.threads : (rank + 1) * job.threads]
                os.sched_setaffinity(started[-1].pid, own_cores)
        outputs = [process.communicate()[0] for process in started]
    if any(process.returncode for process in started):
        raise RuntimeError(f"a process of {job} failed, see above")
    return Run(job, [json.loads(output.splitlines()[-1]) for output in outputs])


def _main() -> None:
    """Do the job of the command line, and print what it took."""
    job = Job(**json.loads(sys.argv[1]))
    limit_threads(job.threads)
    print(json.dumps(work(job)))


if __name__ == "__main__":
    _main()

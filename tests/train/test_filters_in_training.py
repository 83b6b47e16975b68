"""Filters inside what trains modules: Lightning's checkpoints, and data-parallel processes."""

import lightning
import pytest
import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from tests.train.forked import run_apart
from torchpose import GaussianMixture
from torchpose.filters import MixtureKalmanFilter

# Lightning on how many workers a loader has, DDP on the strides of gradients of one number.
pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]


def learnt_filter(process, noise):
    means = torch.tensor([[-1.0, 0.0], [1.0, 0.5]], dtype=torch.float64)
    mixture = GaussianMixture(
        torch.tensor([0.4, 0.6], dtype=torch.float64), means, torch.eye(2).double().expand(2, 2, 2)
    )
    parameters = (nn.Parameter(torch.full((n,), v)) for n, v in ((2, process), (1, noise)))
    return MixtureKalmanFilter(mixture, *parameters, observed=[0])


def measurements(seed=0):
    return torch.randn(4, 6, 1, generator=torch.Generator().manual_seed(seed)).double()


class Learner(lightning.LightningModule):
    def __init__(self, process=0.5, noise=1.0):
        super().__init__()
        self.save_hyperparameters()
        self.filter = learnt_filter(process, noise)

    def training_step(self, batch, _):
        return -self.filter(batch).log_evidence.mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.1)


def test_lightning_trains_a_filter_and_loads_it_from_its_checkpoint(tmp_path):
    learner = Learner()
    before = [p.detach().clone() for p in learner.parameters()]
    trainer = lightning.Trainer(
        max_epochs=3, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, default_root_dir=tmp_path,
    )  # fmt: skip
    data = torch.utils.data.DataLoader(list(measurements()), batch_size=2, num_workers=0)
    trainer.fit(learner, data)
    assert all(not torch.equal(a, b) for a, b in zip(before, learner.parameters(), strict=True))
    trainer.save_checkpoint(tmp_path / "learner.ckpt")
    loaded = Learner.load_from_checkpoint(tmp_path / "learner.ckpt", weights_only=False)
    with torch.no_grad():
        expected, found = learner.filter(measurements(5)), loaded.filter(measurements(5))
    torch.testing.assert_close(found.mean, expected.mean, rtol=0, atol=0)
    torch.testing.assert_close(found.log_evidence, expected.log_evidence, rtol=0, atol=0)


def train_in_parallel():
    """Train a filter alone and as one of one process; their steps are equal."""
    dist.init_process_group("gloo", store=dist.HashStore(), rank=0, world_size=1)
    alone, wrapped = learnt_filter(0.5, 1.0), learnt_filter(0.5, 1.0)
    parallel = DistributedDataParallel(wrapped)
    for _ in range(2):  # the second step builds on a graph of its own
        for model in (alone, parallel):
            model.zero_grad()
            (-model(measurements()).log_evidence.sum()).backward()
        for own, other in zip(alone.parameters(), wrapped.parameters(), strict=True):
            torch.testing.assert_close(own.grad, other.grad)
            with torch.no_grad():
                own -= 0.01 * own.grad
                other -= 0.01 * other.grad
    assert bool(wrapped.process_cov.grad.abs().sum() > 0)
    return parallel


def test_data_parallel_processes_train_a_filter():
    run_apart(train_in_parallel)

"""Training step at the paper's scale on a CUDA GPU: speed relative to a matrix product, and memory."""

from __future__ import annotations

import os
from collections.abc import Callable

import torch
import torch.utils.deterministic
from hydra.utils import instantiate
from lightning import LightningModule
from torch import Tensor
from torch._dynamo.exc import BackendCompilerFailed
from torch.utils.flop_counter import FlopCounterMode

from imagination.geometry.grid import cells_of
from imagination.models.segmentation.lit_segmentation import LitSegmentation
from tests.benchmarks.measure import Figure, medians, unmeasured
from tests.benchmarks.subjects import SEED, config

EXPERIMENTS = {
    "unit, resnet18, unet": "chair_unet",
    "ensemble of 3 units": "all_units",
    "HRNetV2 w48": "segmentation_hrnet",
}
KINDS = {"32-true": torch.float32, "bf16-mixed": torch.bfloat16}
PARTS = (1, 2, 4, 6, 12)
"""Numbers of parts of a batch (`data.micro_batches`); the smallest that fits into the memory of the GPU is used."""

SIDE = 8192
"""Side of the multiplied matrices."""


def run(folder: str) -> list[Figure]:
    """Return all figures."""
    if not torch.cuda.is_available():
        return [unmeasured("training at the paper's scale", "no CUDA GPU")]
    use_training_kernels()
    kinds = [kind for kind in KINDS if kind == "32-true" or torch.cuda.is_bf16_supported()]
    figures = [
        figure for name in EXPERIMENTS for kind in kinds for figure in step_figures(folder, name, kind)
    ]
    return figures + [compiled_figure(folder, kind) for kind in kinds]


def use_training_kernels() -> None:
    """Select deterministic kernels, as `trainer.deterministic=warn` does."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]


def step_figures(folder: str, name: str, kind: str) -> list[Figure]:
    """Return the speed and memory of a training step of one network in one precision."""
    what = f"training step, {name}, {kind}"
    for parts in PARTS:
        step: Callable[[], None] | None = None  # frees the memory of the previous step
        try:
            step, size = training_step(folder, EXPERIMENTS[name], kind, parts)
            with FlopCounterMode(display=False) as counter:
                step()
            torch.cuda.reset_peak_memory_stats()
            seconds = medians({"step": step}, 5.0, 3)["step"]
        except torch.OutOfMemoryError:
            torch.cuda.empty_cache()
            continue
        memory = torch.cuda.max_memory_allocated() / 1e9
        what += f", batch of {size}" + (f" in {parts} parts" if parts > 1 else "")
        flops = counter.get_total_flops()
        return [
            Figure(
                f"{what}, {flops / size / 1e9:.1f} GFLOP a sample: {size / seconds:.0f} samples/s",
                flops / seconds / 1e12,
                "TFLOP/s",
                2 * SIDE**3 / medians({"product": product(kind)}, 2.0)["product"] / 1e12,
                f"matrix product of {SIDE}², {'TF32' if kind == '32-true' else 'bfloat16'}",
            ),
            Figure(f"{what}: peak memory", memory, "GB"),
        ]
    return [unmeasured(what, f"a batch in {PARTS[-1]} parts does not fit into this GPU's memory")]


def product(kind: str) -> Callable[[], None]:
    """Return a synchronised matrix product with the data type of the convolutions."""
    first, second = (torch.randn(SIDE, SIDE, device="cuda", dtype=KINDS[kind]) for _ in range(2))

    def multiply() -> None:
        before = torch.backends.cuda.matmul.allow_tf32
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32
        first @ second
        torch.backends.cuda.matmul.allow_tf32 = before
        torch.cuda.synchronize()

    return multiply


def compiled_figure(folder: str, kind: str) -> Figure:
    """Return the speed of the unit's step with torch.compile relative to the default."""
    what = f"training step, unit, resnet18, unet, {kind}, with torch.compile"
    try:
        (compiled, size), (default, _) = (
            training_step(folder, "chair_unet", kind, 1, "scale=paper", f"model.module.compile={on}")
            for on in ("true", "false")
        )
        times = medians({"compiled": compiled, "default": default}, 5.0, 3)
    except (torch.OutOfMemoryError, BackendCompilerFailed) as error:
        return unmeasured(what, str(error).partition("\n")[0])
    return Figure(
        what, size / times["compiled"], "samples/s", size / times["default"], "as configured", rival=True
    )


def training_step(
    folder: str,
    experiment: str,
    kind: str,
    parts: int,
    *overrides: str,
    device: str = "cuda",
) -> tuple[Callable[[], None], int]:
    """Return a synchronised step as configured (forward, loss, backward, optimiser), and its number of random views."""
    torch.manual_seed(SEED)
    run_config = config(folder, *(overrides or ("scale=paper",)), experiment=experiment)
    module: LightningModule = instantiate(run_config.model.module).to(device)
    if run_config.model.module.get("compile"):
        module.unit.compile()
    optimizer = module.optimizer(module.parameters())
    cells = cells_of(run_config.ego.extent, run_config.ego.resolution)
    batch = random_batch(
        run_config.data.batch_size // parts,
        run_config.camera.width,
        cells,
        len(run_config.unit_categories),
        device,
    )

    def step() -> None:
        optimizer.zero_grad()
        for _ in range(parts):
            with torch.autocast(device, torch.bfloat16, enabled=kind == "bf16-mixed"):
                loss = loss_of(module, batch)
            loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        if device == "cuda":
            torch.cuda.synchronize()

    return step, run_config.data.batch_size // parts * parts


def loss_of(module: LightningModule, batch: dict[str, Tensor]) -> Tensor:
    """Return the loss of a unit or of a first-person segmentation."""
    if isinstance(module, LitSegmentation):
        return module.compare(batch)[0]
    loss, _ = module.loss(module(batch), batch["label"], batch["neighbourhood"])
    return loss


def random_batch(views: int, image: int, cells: int, categories: int, device: str) -> dict[str, Tensor]:
    """Return a random batch with the shapes and types of the data module; the content does not affect the time."""
    draw = torch.Generator(device).manual_seed(SEED)

    def integers(high: int, *shape: int) -> Tensor:
        return torch.randint(0, high, (views, *shape), generator=draw, device=device, dtype=torch.uint8)

    return {
        "rgb": integers(256, 3, image, image).contiguous(memory_format=torch.channels_last),
        "depth": 5 * torch.rand(views, 1, image, image, generator=draw, device=device).half(),
        "occupied": integers(2, 1, cells, cells),
        "seen": integers(2, 1, cells, cells),
        "label": integers(2, categories, cells, cells),
        "neighbourhood": torch.ones(views, categories, cells, cells, device=device, dtype=torch.uint8),
        "segmentation": integers(1 + categories, image, image),
    }

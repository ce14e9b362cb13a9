"""What networks compute in: Lightning's names of precisions, and `auto`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from imagination.errors import check_choice

if TYPE_CHECKING:  # commands name precisions before they need torch
    import torch

PRECISIONS = ("auto", "32-true", "64-true", "bf16-mixed", "bf16-true", "16-mixed", "16-true")


def resolved(asked: str) -> str:
    """Lightning's name of a precision; `auto` takes bfloat16 where the hardware computes it, twice as fast.

    Raises:
        UserError: if it is none of `PRECISIONS`.
    """
    import torch

    check_choice("precision", asked, PRECISIONS)
    if asked != "auto":
        return asked
    if torch.cuda.is_available():
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        able = torch.cpu.get_capabilities()
        native = bool(able.get("avx512_bf16") or able.get("amx_bf16"))
    return "bf16-mixed" if native else "32-true"


def answering(asked: str) -> torch.autocast:
    """A context in which trained networks, whose weights are float32, answer in the precision they were trained in."""
    import torch

    kinds = {"bf16": torch.bfloat16, "16": torch.float16}
    kind = kinds.get(resolved(asked).partition("-")[0])
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.autocast(device, kind or torch.bfloat16, enabled=kind is not None)

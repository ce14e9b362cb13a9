"""A user's own HRNetV2 weights, trained on ADE20K, in the layout of a public release.

The layout is that of github.com/CSAILVision/semantic-segmentation-pytorch, ade20k-hrnetv2-c1: one folder with
encoder_*.pth and decoder_*.pth, state dicts of HRNetV2-W48 and of its `c1` decoder for the 150 classes of the MIT Scene
Parsing Benchmark (Zhou et al. 2017, Scene Parsing through ADE20K Dataset). Which of these belong to which category
stands in the category table, `aliases.ade20k` (conf/categories).
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor, nn

from imagination.geometry.camera import Camera
from imagination.models.segmentation.hrnet import HRNetV2, at_size
from imagination.models.weights import mismatches
from imagination.scenes.categories import CategoryTable
from imagination.utils.errors import UserError

SOURCE = "ade20k"

SHORTER_SIDE = 450
"""Pixels that images are enlarged to: the middle one of the release's test sizes, 300 to 600."""

CLASSES = tuple(
    """wall building sky floor tree ceiling road bed windowpane grass cabinet sidewalk person earth door table
    mountain plant curtain chair car water painting sofa shelf house sea mirror rug field armchair seat fence desk rock
    wardrobe lamp bathtub railing cushion base box column signboard chest_of_drawers counter sand sink skyscraper
    fireplace refrigerator grandstand path stairs runway case pool_table pillow screen_door stairway river bridge
    bookcase blind coffee_table toilet flower book hill bench countertop stove palm kitchen_island computer
    swivel_chair boat bar arcade_machine hovel bus towel light truck tower chandelier awning streetlight booth
    television airplane dirt_track apparel pole land bannister escalator ottoman bottle buffet poster stage van ship
    fountain conveyer_belt canopy washer plaything swimming_pool stool barrel basket waterfall tent bag minibike cradle
    oven ball food step tank trade_name microwave pot animal bicycle lake dishwasher screen blanket sculpture hood
    sconce vase traffic_light tray ashcan fan pier crt_screen plate monitor bulletin_board shower radiator glass clock
    flag""".split()
)
"""The benchmark's classes in the order of the network's outputs."""

LEFT_OUT = ("num_batches_tracked", "_tmp_running_mean", "_tmp_running_var", "_running_iter")
"""Endings of entries that only training uses; some are of the release's own batch normalisation."""

DECODER = {"cbr.": "decoder.0.", "conv_last.": "decoder.1."}
"""The `c1` decoder's parts and ours."""


class PublicHRNet(nn.Module):
    """HRNetV2-W48 for ADE20K's classes, answering in our categories.

    Args:
        table: tells which classes belong to which category.
        camera: that takes the images.
        tta_hflip: answer with the mean of what is said of an image and of it in a mirror, as units do.

    Raises:
        UserError: if a category claims a class that does not exist, or none claims any.
    """

    place: Tensor

    def __init__(self, table: CategoryTable, camera: Camera, tta_hflip: bool = False) -> None:
        super().__init__()
        self.tta_hflip = tta_hflip
        self.categories = [row.name for row in table if row.aliases.get(SOURCE)]
        if not self.categories:
            raise UserError(
                f"categories: no row lists aliases.{SOURCE}, expected the classes that belong to it"
            )
        place = torch.zeros(len(CLASSES), dtype=torch.uint8)
        for number, name in enumerate(self.categories):
            for label in table.rows[table.index(name) - 1].aliases[SOURCE]:
                if label not in CLASSES:
                    raise UserError(
                        f"categories: {name} claims {label!r} of {SOURCE}, expected classes among: "
                        f"{', '.join(CLASSES)}"
                    )
                place[CLASSES.index(label)] = number + 1
        self.register_buffer("place", place, persistent=False)
        enlarge = max(1.0, SHORTER_SIDE / min(camera.width, camera.height))
        self.network = HRNetV2("hrnet_w48", len(CLASSES), enlarge)

    @classmethod
    def load(
        cls, folder: Path, table: CategoryTable, camera: Camera, tta_hflip: bool = False
    ) -> "PublicHRNet":
        """The network with the weights in a folder, in evaluation mode on the CPU.

        Raises:
            UserError: if files are missing or damaged, or are weights of another architecture.
        """
        made = cls(table, camera, tta_hflip)
        encoder, decoder = (read(folder, part) for part in ("encoder", "decoder"))
        fill(made.network, renamed(encoder, decoder), folder)
        return made.eval()

    @torch.no_grad()
    def segment(
        self, rgb: UInt8[Tensor, "b 3 h w"], rows: int, columns: int
    ) -> UInt8[Tensor, "b rows columns"]:
        """The likeliest category of each pixel, its place + 1, or 0 where a class of none is likelier.

        Classes of one category (chair, armchair, swivel chair) do not compete: their probabilities are added up.
        """
        rgb = rgb.to(self.place.device)
        logits = self.network(rgb)
        if self.tta_hflip:
            logits = (logits + self.network(rgb.flip(-1)).flip(-1)) / 2
        probabilities = at_size(logits, rows, columns).softmax(dim=1)
        other = probabilities[:, self.place == 0].amax(dim=1, keepdim=True)
        own = [
            probabilities[:, self.place == number + 1].sum(dim=1, keepdim=True)
            for number in range(len(self.categories))
        ]
        return torch.cat([other, *own], dim=1).argmax(dim=1).to(torch.uint8)


def read(folder: Path, part: str) -> dict[str, Tensor]:
    """The state dict in the folder's encoder_*.pth or decoder_*.pth.

    Raises:
        UserError: if there is not exactly one such file, or it holds anything but tensors by name.
    """
    paths = sorted(folder.glob(f"{part}_*.pth"))
    if len(paths) != 1:
        found = ", ".join(path.name for path in paths) or "none"
        raise UserError(f"ade20k: got {found} in {folder}, expected one file {part}_*.pth")
    try:
        state = torch.load(paths[0], map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever the broken part makes it raise
        raise UserError(
            f"ade20k: {paths[0]} cannot be read, it is truncated or holds more than weights; download it again"
        ) from error
    if not isinstance(state, dict) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()
    ):
        raise UserError(f"ade20k: {paths[0]} holds no state dict, expected tensors by name")
    return state


def renamed(encoder: Mapping[str, Tensor], decoder: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The release's weights by our network's names; names that it does not know stay as they are."""
    ours = {}
    for part, state in (("encoder", encoder), ("decoder", decoder)):
        for name, tensor in state.items():
            name = name.removeprefix("module.")
            if name.endswith(LEFT_OUT):
                continue
            known = {"": "encoder."} if part == "encoder" else DECODER
            prefix = next((prefix for prefix in known if name.startswith(prefix)), None)
            ours[name if prefix is None else known[prefix] + name.removeprefix(prefix)] = tensor
    return ours


def fill(network: nn.Module, weights: Mapping[str, Tensor], origin: Path) -> None:
    """Load weights by name.

    Raises:
        UserError: if names or shapes differ, with the first of them.
    """
    expected = {name: value for name, value in network.state_dict().items() if not name.endswith(LEFT_OUT)}
    if differences := mismatches(weights, expected):
        raise UserError(
            f"ade20k: the weights in {origin} are of another architecture than HRNetV2-W48 with the c1 decoder and "
            f"{len(CLASSES)} classes; {differences}"
        )
    network.load_state_dict(dict(weights), strict=False)  # without the counters that only training uses

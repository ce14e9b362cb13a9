"""Ground truth of a scene as arrays and pictures: `python -m imagination.render scene=test_0000`."""

import logging
import re
import sys
from contextlib import closing
from pathlib import Path
from time import perf_counter
from typing import NamedTuple, cast

import numpy as np
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig

from imagination import runs
from imagination.categories import CategoryTable
from imagination.config import command
from imagination.errors import check_choice, check_range, require_extra
from imagination.geometry.morphology import kernel_cells
from imagination.ground_truth import pictures
from imagination.ground_truth.label import imaginable_mask, label, neighbourhood
from imagination.ground_truth.maps import GroundTruth
from imagination.ground_truth.pictures import Look
from imagination.progress import progress
from imagination.scenes.renderer import SceneRenderer, renderer_of
from imagination.scenes.scene import SPLITS, Scene, Split
from imagination.views.poses import sample_poses
from imagination.views.view import Observer, View

log = logging.getLogger(__name__)


class Kernels(NamedTuple):
    """Sides of the squares that make V_filter and M*_seen, cells."""

    imaginable: int
    neighbourhood: int


@command("render")
def main(config: DictConfig) -> None:
    """Write the ground truth and some views of one scene, or the views of a whole corpus."""
    if "shards" in config:
        write_corpus(config)
        return
    check_range("poses", config.poses, 1, 10_000, "views")
    observer: Observer = instantiate(config.data.observer)
    split = cast(Split, check_choice("split", config.split, SPLITS))
    name = config.scene or observer.source.scenes(split)[0]
    folder = Path(config.folder) / folder_name(name)
    try:
        draw(config, observer, name, folder)
    except KeyboardInterrupt:
        print(f"Interrupted; not all files of {folder}/ are written. Start again.", file=sys.stderr)
        sys.exit(130)


def folder_name(scene: str) -> str:
    """One folder's name for a scene whose name may be a path, as a file of Habitat's is."""
    return re.sub(r"[^\w.-]+", "_", scene).strip("._")


def draw(config: DictConfig, observer: Observer, name: str, folder: Path) -> None:
    """Write everything about one scene."""
    scene, truth = observer.scene(name), observer.truth(name)
    folder.mkdir(parents=True, exist_ok=True)
    with runs.logging_to(folder / "render.log"):
        for line in summary(scene, truth, observer.categories):
            log.info(line)
        sizes = config.kernels.imaginable, config.kernels.neighbourhood
        kernels = Kernels(*(kernel_cells(size, observer.ego.resolution) for size in sizes))
        looks = choose_looks(observer, name, config.poses, config.seed, kernels)
        save_arrays(
            folder / "truth.npz", {**truth.to_arrays(), "categories": np.array(observer.categories.names)}
        )
        save_arrays(folder / "views.npz", stack(looks))
        save_figure(folder / "scene.png", pictures.draw_scene(scene, truth, observer.categories, looks))
        for category in observer.categories.names:
            save_figure(
                folder / f"{category}.png",
                pictures.draw_category(scene, truth, observer.categories, category),
            )
        save_figure(folder / "views.png", pictures.draw_views(looks, observer.ego))
        save_figure(folder / "labels.png", pictures.draw_labels(looks, observer.ego, observer.categories))
        log.info("Written: %s/ (truth.npz, views.npz and pictures)", folder)


def write_corpus(config: DictConfig) -> None:
    """Render the views of all homes of a split into shards; homes that are there already stay, broken ones are told."""
    from imagination.data import corpus  # with it comes torch

    require_extra("litdata", "shards")
    check_range("parts", config.parts, 1, 1_000_000, "jobs")
    check_range("part", config.part, 0, config.parts - 1)
    observer: Observer = instantiate(config.data.observer)
    split = cast(Split, check_choice("split", config.split, SPLITS))
    recipe = corpus.Recipe(
        instantiate(config.data.sampler), config.seed, config.views, config.scale.update_interval
    )
    folder, homes = Path(config.shards), observer.source.scenes(split)[config.part :: config.parts]
    folder.mkdir(parents=True, exist_ok=True)
    log_file = folder / f"render_{config.part}_of_{config.parts}.log"
    with runs.logging_to(log_file), corpus.at_work(folder):
        left = corpus.unwritten(folder, observer, homes, recipe)
        begin, failed = perf_counter(), []
        with closing(corpus.write_homes(observer, left, folder, recipe, config.scale.workers)) as done:
            for home, problem in progress(done, f"views of homes ({split})", len(left)):
                if problem:
                    failed.append(home)
                    log.error("%s is left out: %s", home, problem)
        seconds = perf_counter() - begin
        about = corpus.write_index(folder, observer, recipe)
        count, size = len(about["homes"]), sum(path.stat().st_size for path in folder.glob("chunk-*.bin"))
        per_view = size / (count * recipe.views)
        log.info(
            "%s: %d homes, %d views, %.1f kB a view", folder, count, count * recipe.views, per_view / 1e3
        )
        if written := len(left) - len(failed):
            pace = written * recipe.views / seconds
            log.info(
                "%.0f views/s on %d processes, the homes and their truth included: a million take %.1f hours and "
                "%.0f GB",
                *(pace, max(1, config.scale.workers), 1e6 / pace / 3600, per_view * 1e6 / 1e9),
            )
        if failed:
            log.error(
                "%d homes failed: %s; run this again to try them once more", len(failed), ", ".join(failed)
            )
        log.info("Train on them: python -m imagination.train data=shards data.shards=%s", folder)


def summary(scene: Scene, truth: GroundTruth, categories: CategoryTable) -> list[str]:
    """What the scene contains, and how much of it is in the ground truth."""
    cell = truth.grid.resolution**2
    free = scene.free_space.mask.sum() * scene.free_space.grid.resolution**2
    lines = [
        f"{scene.name}: {len(scene.mesh.faces)} triangles, {free:.1f} m2 free, {len(truth.points)} points"
    ]
    for layer, name in enumerate(categories.names):
        count, area = len(scene.of_category(name)), truth.truth[layer].sum() * cell
        shared = truth.truth[layer] & np.delete(truth.truth, layer, axis=0).any(axis=0)
        share = shared.sum() / max(truth.truth[layer].sum(), 1)
        lines.append(
            f"{name}: {count} objects, {area:.2f} m2 of truth, {share:.1%} of it also another category's"
        )
    return lines


def choose_looks(observer: Observer, name: str, poses: int, seed: int, kernels: Kernels) -> list[Look]:
    """Of random views, for each category the one with the largest label."""
    rng = np.random.default_rng(seed)
    scene = observer.scene(name)
    views = [observer.observe(name, pose, rng) for pose in sample_poses(scene.free_space, poses, rng)]
    sizes = np.array(
        [label(view.object, view.seen[None], kernels.imaginable).sum(axis=(1, 2)) for view in views]
    )
    renderer = renderer_of(scene)
    looks = []
    for layer in range(len(observer.categories)):
        best = int(sizes[:, layer].argmax())
        sizes[best] = -1  # no view twice, where there are enough
        looks.append(develop(views[best], layer, observer, renderer, scene.floor_height, kernels))
    return looks


def develop(
    view: View, layer: int, observer: Observer, renderer: SceneRenderer, floor: float, kernels: Kernels
) -> Look:
    """Everything that becomes of a view for one category."""
    objects = view.object[layer]
    image = renderer.render(observer.camera, observer.camera.to_world(view.pose, floor))
    return Look(
        view.pose,
        layer,
        view.rgb,
        view.depth,
        image.instance,
        view.occupied,
        view.seen,
        objects,
        imaginable_mask(objects, view.seen, kernels.imaginable),
        label(objects, view.seen, kernels.imaginable),
        neighbourhood(objects, view.seen, kernels.neighbourhood),
    )


def stack(looks: list[Look]) -> dict[str, np.ndarray]:
    """Views as arrays with a leading axis."""
    return {field: np.stack([np.asarray(getattr(look, field)) for look in looks]) for field in Look._fields}


def save_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays whole or not at all."""
    with runs.replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]


def save_figure(path: Path, figure: Figure) -> None:
    """Write a picture whole or not at all."""
    with runs.replacing(path) as temporary:
        figure.savefig(temporary)


if __name__ == "__main__":
    main()

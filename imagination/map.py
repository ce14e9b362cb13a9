"""Map a recording: `python -m imagination.map recording=tum recording.path=FOLDER unit=chair.onnx`."""

from __future__ import annotations

import logging
import sys

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from imagination.deployment import mapper_from_config
from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.recordings.recording import Frames, Recording
from imagination.runs.command import command
from imagination.runs.command_line import command_line, own_arguments
from imagination.runs.folder import CONFIG, point_latest
from imagination.runs.hydra_folder import experiment_folder, new_run_folder
from imagination.runs.logging import logging_to
from imagination.utils import interrupts
from imagination.utils.atomic_io import write_text
from imagination.utils.errors import UserError
from imagination.viewers.viewer import Viewer

log = logging.getLogger(__name__)


def validate(config: DictConfig) -> None:
    """Check the values of the config before any file is read.

    Raises:
        UserError: on the first value that is missing or out of range.
    """
    mapper_from_config.validate(config)
    if OmegaConf.is_missing(config.recording, "path"):
        raise UserError("recording.path: got none, expected a folder or a bag: recording.path=…")


@command("map", validate)
def main(config: DictConfig) -> None:
    """Map all frames of a recording and save the map."""
    predictor = mapper_from_config.predictor_of(config)
    recording: Recording = instantiate(config.recording, _convert_="all")
    viewer: Viewer = instantiate(config.viewer)
    mapper = mapper_from_config.mapper_of(config, predictor, recording.camera, recording.world)
    folder = new_run_folder(config)
    config.paths.run = str(folder)
    with logging_to(folder / "run.log"):
        write_text(folder / CONFIG, OmegaConf.to_yaml(config, resolve=True))
        frames = Frames(recording)
        viewer.open(folder, mapper)
        try:
            status = map_frames(mapper, frames, viewer)
        finally:
            try:
                if frames.mapped:  # also after an error
                    with interrupts.postponed():
                        mapper.save(folder)
                        point_latest(folder, experiment_folder(config))
                    log.info("Map: %s/ (map.yaml, map.png, semantic.npz, objects.geojson)", folder)
            finally:
                viewer.close()
    sys.exit(status)


def map_frames(mapper: SemanticMapper, frames: Frames, viewer: Viewer) -> int:
    """Map every frame and return the exit code: 0, 1 if an error ends the recording early, 130 or 143 after a signal.

    Raises:
        UserError: if no frame was mapped.
    """
    status, outside, first_refusal = 0, 0, ""
    try:
        for frame in frames:
            try:
                update = mapper.update(frame.rgb, frame.depth, frame.camera_to_world)
            except UserError as error:
                frames.refuse("refused by the mapper (see the first reason below)")
                first_refusal = first_refusal or str(error)
                continue
            except BaseException:
                frames.refuse("interrupted while it was mapped")
                raise
            outside += update.outside
            viewer.show(frame.stamp, update)
    except UserError as error:  # damaged recording, or a viewer that cannot write
        status = 1
        log.error("error: %s%s", error, "; the frames before it are mapped and saved" * bool(frames.mapped))
    except KeyboardInterrupt:
        status, again = interrupts.exit_code(), command_line("map", own_arguments(without=["hydra.run.dir"]))
        saved = f"The map of {frames.mapped} frames is saved; " if frames.mapped else ""
        interrupts.report(f"{saved}map the whole recording with: {again}")
        if not frames.mapped:
            sys.exit(status)
    if first_refusal:
        log.warning("Reason of the first refused frame: %s", first_refusal)
    if not frames.mapped:
        raise UserError(f"recording: no frame was mapped. {frames.summary()}")
    log.info("%s", frames.summary())
    if outside:
        log.warning(
            "%d observed cells are outside the map of fixed size; enlarge or move the map (extent, centre)",
            outside,
        )
    return status


if __name__ == "__main__":
    main()

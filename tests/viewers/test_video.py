import resource
import sys
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
from PIL import Image

from imagination.mapping.semantic_mapper import SemanticMapper
from imagination.utils.errors import UserError
from imagination.viewers.video import Preview
from imagination.viewers.viewer import NoViewer, Viewer
from tests.helpers.toy_units import Toy
from tests.mapping.test_semantic_mapper import frames


def play(viewer: Viewer, folder: Path, repeats: int = 1) -> SemanticMapper:
    mapper = SemanticMapper(Toy())
    viewer.open(folder, mapper)
    for _ in range(repeats):
        for number, frame in enumerate(frames()):
            viewer.show(number * 10**8, mapper.update(*frame))
    viewer.close()
    return mapper


def test_a_film_as_mp4(tmp_path: Path) -> None:
    play(Preview("mp4", rate=5.0), tmp_path)
    film = cv2.VideoCapture(str(tmp_path / "preview.mp4"))
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(5.0)
    pictures = [film.read() for _ in range(4)]
    assert [found for found, _ in pictures] == [True, True, True, False]
    assert pictures[0][1].shape == (480, 960, 3)
    assert np.abs(pictures[0][1].astype(int) - pictures[2][1]).mean() > 2


def test_a_film_as_gif_is_thinned_where_it_is_long(tmp_path: Path) -> None:
    play(Preview("gif", max_frames=4), tmp_path, repeats=3)
    with Image.open(tmp_path / "preview.gif") as film:
        assert 2 <= film.n_frames <= 5 and film.size == (960, 480)  # type: ignore[attr-defined]


@pytest.mark.parametrize("format", ["gif", "mp4"])
def test_a_film_is_unpacked_frame_by_frame(tmp_path: Path, format: str) -> None:
    viewer = Preview(format)
    play(viewer, tmp_path, repeats=4)
    tracemalloc.start()
    viewer.close()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 * 960 * 480 * 3  # there are twelve


@pytest.mark.parametrize("format", ["gif", "mp4"])
def test_a_full_disk_is_reported_and_leaves_no_film(tmp_path: Path, format: str) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(UserError, match=rf"preview.{format}: "):
            play(Preview(format), tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_a_first_frame_without_a_return_shows_an_empty_map(tmp_path: Path) -> None:
    mapper, viewer = SemanticMapper(Toy()), Preview("mp4")
    viewer.open(tmp_path, mapper)
    rgb, depth, pose = frames()[0]
    viewer.show(0, mapper.update(rgb, np.zeros_like(depth), pose))
    viewer.show(10**8, mapper.update(rgb, depth, pose))
    viewer.close()
    film = cv2.VideoCapture(str(tmp_path / "preview.mp4"))
    assert [film.read()[0] for _ in range(3)] == [True, True, False]


def test_no_frame_no_film(tmp_path: Path) -> None:
    for viewer in (Preview("mp4"), NoViewer()):
        viewer.open(tmp_path, SemanticMapper(Toy()))
        viewer.close()
        assert isinstance(viewer, Viewer)
    assert not list(tmp_path.iterdir())
    with pytest.raises(UserError, match="viewer.format: got 'avi'"):
        Preview("avi")


def test_a_missing_rerun_says_what_to_install() -> None:
    try:
        import rerun  # noqa: F401
    except ImportError:
        from imagination.viewers.rerun import Rerun

        with pytest.raises(UserError, match=r"pip install -e '\.\[rerun\]'"):
            Rerun()


def test_rerun_writes_a_file(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    from imagination.viewers.rerun import Rerun

    play(Rerun("map.rrd"), tmp_path)
    assert (tmp_path / "map.rrd").stat().st_size > 10_000


def test_the_path_that_is_sent_to_rerun_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a stand-in for rerun, which may not be installed."""
    from imagination.viewers import rerun

    sent: list[int] = []
    stand_in = SimpleNamespace(
        **dict.fromkeys(("Image", "DepthImage", "Points2D"), lambda *_, **__: None),
        LineStrips2D=lambda strips: sent.append(len(strips[0])),
        RecordingStream=lambda _: MagicMock(),
    )
    monkeypatch.setitem(sys.modules, "rerun", stand_in)
    monkeypatch.setattr(rerun, "require_extra", lambda *_: None)
    monkeypatch.setattr(rerun, "MAX_PLACES", 6)
    play(rerun.Rerun("map.rrd", every=1), tmp_path, repeats=5)
    assert max(sent) == 6 and len(sent) == 16

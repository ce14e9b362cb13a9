"""Sweet Home 3D: reading of catalogues and homes, unusable models, and limits for untrusted archives."""

import io
import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from imagination.scenes.building_blocks.palette import Palette
from imagination.scenes.categories import CategoryTable
from imagination.scenes.procedural.source import ProceduralHomes
from imagination.scenes.source import SPLITS
from imagination.utils.cache import Cache
from imagination.utils.errors import UserError
from tests.helpers.scene_sources import configured, source
from tests.helpers.sweet_home import (
    CHAIR,
    MATERIALS,
    TABLE,
    Box,
    entry,
    furnished,
    home_xml,
    obj,
    piece,
    walls,
    write_archive,
    write_catalogue,
    write_home,
)

from imagination_sweethome3d import archives, catalogue, furniture, home_file, labels  # isort: skip
from imagination_sweethome3d import homes as home_source  # isort: skip
from imagination_sweethome3d import obj as obj_file  # isort: skip
from imagination_sweethome3d.obj import read_obj  # isort: skip
from imagination_sweethome3d.shell import build_shell  # isort: skip

SIZE = (0.5, 0.5, 0.9)


# archives


@pytest.mark.parametrize(
    "name", ["../evil.obj", "/etc/passwd", "a/../../evil", "C:/evil", "..\\evil", ".", "/.."]
)
def test_a_member_outside_the_archive_is_refused(tmp_path: Path, name: str) -> None:
    path = write_archive(tmp_path / "a.zip", {name: "x"})
    with pytest.raises(UserError, match="leads out of the archive"), archives.open_archive(path):
        pass


def test_a_member_without_a_name_is_refused(tmp_path: Path) -> None:
    content = write_archive(tmp_path / "a.zip", {"x": "y"}).read_bytes()
    local, directory = content.split(b"PK\x01\x02")
    path = tmp_path / "b.zip"  # the name of one letter in the directory becomes a comment
    path.write_bytes(local + b"PK\x01\x02" + directory[:24] + b"\0\0\0\0\1\0" + directory[30:])
    with pytest.raises(UserError, match="member ''"), archives.open_archive(path):
        pass


def test_a_zip_bomb_is_refused(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "a.zip", {"bomb": b"\0" * (archives.MAX_MEMBER + 1), "good": "x"})
    with archives.open_archive(path) as archive:
        assert archive.read("good") == b"x"
        with pytest.raises(UserError, match="bomb unpacks from .* to 67108865"):
            archive.read("bomb")


def test_a_member_with_a_wrong_size_is_refused(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "a.zip", {"liar": bytes(range(256)) * 8})
    content = path.read_bytes()
    place = content.rindex(b"PK\x01\x02") + 24  # the directory's uncompressed size
    path.write_bytes(content[:place] + struct.pack("<I", 100) + content[place + 4 :])
    with archives.open_archive(path) as archive, pytest.raises(UserError, match="liar"):
        archive.read("liar")


def test_a_damaged_member_and_a_file_that_is_not_an_archive_are_reported(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "a.zip", {"thing": "some text that is packed, and packed well" * 9})
    content = bytearray(path.read_bytes())
    content[40:60] = b"\xff" * 20
    path.write_bytes(bytes(content))
    with archives.open_archive(path) as archive, pytest.raises(UserError, match=r"a\.zip: thing"):
        archive.read("thing")
    (tmp_path / "text.sh3d").write_text("no zip")
    for name, message in (("text.sh3d", "is not a zip file"), ("none.sh3d", "does not exist")):
        with pytest.raises(UserError, match=message), archives.open_archive(tmp_path / name):
            pass


def test_an_archive_of_a_later_zip_version_is_reported(tmp_path: Path) -> None:
    path = write_archive(tmp_path / "a.zip", {"thing": "x"})
    content = bytearray(path.read_bytes())
    content[content.rindex(b"PK\x01\x02") + 6] = 99  # version needed to extract
    path.write_bytes(bytes(content))
    with pytest.raises(UserError, match="zip file version 9.9"), archives.open_archive(path):
        pass


# models


def model(tmp_path: Path, text: str) -> object:
    path = write_archive(tmp_path / "m.zip", {"m.obj": text, "model.mtl": MATERIALS})
    with archives.open_archive(path) as archive:
        return read_obj(archive, "m.obj")


def test_triangles_and_quadrilaterals_keep_their_coordinates(tmp_path: Path) -> None:
    mesh = model(tmp_path, obj(CHAIR[:1]))
    assert len(mesh.faces) == 12 and len(mesh.vertices) == 8
    assert np.ptp(mesh.uv.reshape(-1, 2), axis=0).tolist() == [2.0, 2.0]
    area = np.cross(*np.diff(mesh.vertices[mesh.faces], axis=1).swapaxes(0, 1))
    assert np.linalg.norm(area, axis=1).sum() / 2 == pytest.approx(2 * (45 * 45 + 2 * 45 * 5))


def test_negative_indices_count_from_the_end_and_lines_are_removed(tmp_path: Path) -> None:
    mesh = model(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nf 1 2\n")
    assert mesh.faces.tolist() == [[0, 1, 2]]
    assert mesh.notes == ["1 faces have fewer than three corners"]


@pytest.mark.parametrize("number", [2, -2])
def test_a_texture_coordinate_that_does_not_exist_is_ignored(tmp_path: Path, number: int) -> None:
    face = " ".join(f"{vertex}/{number}" for vertex in (1, 2, 3))
    mesh = model(tmp_path, f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 1 1\nf {face}\n")
    assert len(mesh.faces) == 1 and not mesh.uv.any()


@pytest.mark.parametrize(
    ("line", "message"), [("v 1 two 3", "line 2: got 'v 1 two 3'"), ("f 1 1 9", "vertex 9")]
)
def test_the_number_of_a_malformed_line_is_reported(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        model(tmp_path, f"v 0 0 0\n{line}\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nf" + " 1" * archives.MAX_LINE, "has a line of more than"),
        ("vt 0 0\n" * 101, "got more than 100 vertices"),
        ("v 0 0 0\n" * 101, "got more than 100 vertices"),
        ("v 0 0 0\n" + "f 1 1 1 1 1 1\n" * 30, "got more than 100 vertices"),
        ("mtllib many.mtl\n", "more than 256 materials"),
        ("".join(f"mtllib {number}.mtl\n" for number in range(17)), "more than 16 material files"),
    ],
)
def test_a_model_beyond_the_limits_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, message: str
) -> None:
    monkeypatch.setattr(obj_file, "MAX_ELEMENTS", 100)
    members = {f"{number}.mtl": "" for number in range(17)}
    path = write_archive(tmp_path / "m.zip", {"m.obj": text, "many.mtl": "newmtl x\n" * 300, **members})
    with archives.open_archive(path) as archive, pytest.raises(UserError, match=message):
        read_obj(archive, "m.obj")


def test_repeated_files_are_read_once_and_noted_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = io.BytesIO()
    Image.new("RGB", (4, 4), (200, 100, 0)).save(picture, "PNG")
    materials = "newmtl a\n" + "map_Kd p.png\n" * 9
    text = (
        "mtllib m.mtl\n" * 9 + "mtllib none.mtl\n" * 9 + "usemtl a\n" + obj(CHAIR[:1]).replace("usemtl", "#")
    )
    path = write_archive(tmp_path / "m.zip", {"m.obj": text, "m.mtl": materials, "p.png": picture.getvalue()})
    read: list[str] = []
    with archives.open_archive(path) as archive:
        monkeypatch.setattr(obj_file, "read_texture", lambda archive, name: read.append(name))
        mesh = read_obj(archive, "m.obj")
        many = "".join(f"mtllib {number}.mtl\n" for number in range(99))
    assert read == ["p.png"] and len(mesh.materials) == 2
    assert mesh.notes == ["the material file none.mtl is missing", "the material file model.mtl is missing"]
    assert len(model(tmp_path, many).notes) == obj_file.MAX_NOTES  # type: ignore[attr-defined]


def test_a_texture_of_another_format_than_its_suffix_is_refused(tmp_path: Path) -> None:
    """Pillow would start Ghostscript for this one."""
    script = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\n%%EOF\n"
    path = write_archive(tmp_path / "m.zip", {"x.png": script})
    with (
        archives.open_archive(path) as archive,
        pytest.raises(UserError, match=r"x\.png: cannot be read"),
    ):
        obj_file.read_texture(archive, "x.png")


FLAT = tuple((x0, 5.0, z0, x1, 5.0, z1) for x0, _, z0, x1, _, z1 in CHAIR[:1])


@pytest.mark.parametrize(
    ("content", "changes", "message"),
    [
        ("", {}, "has no faces"),
        (obj(CHAIR), {"width": "120"}, "width: got 1.20 m"),
        (obj(CHAIR), {"width": "90"}, "stretches the mesh 2.0"),
        (obj(FLAT), {}, "stretches the mesh inf"),
        (obj(CHAIR) + "f 1 1 1\n" * 100, {}, "of the triangles have no area"),
        (obj(CHAIR, "air"), {}, "all faces are transparent"),
        ("v 0 0\n", {}, "line 1"),
        (obj(CHAIR), {"model": "/models/none.obj"}, "has no member models/none.obj"),
        (obj(CHAIR), {"model": "/models/chair.dae"}, "model: got models/chair.dae"),
    ],
)
def test_an_invalid_model_is_left_out_with_its_reason(
    tmp_path: Path, content: str, changes: dict[str, str], message: str
) -> None:
    lines = [f"{k}={v}" for k, v in entry(1, "Test#chair", "Chair", CHAIR, **changes).items()]
    members = {
        "PluginFurnitureCatalog.properties": "\n".join(lines),
        "models/chair/model.obj": content,
        "models/chair/model.mtl": MATERIALS,
    }
    path = write_archive(tmp_path / "c.sh3f", members)
    (candidate,) = furniture.candidates([path], Cache(tmp_path / "cache"))
    assert message in candidate.reason
    with pytest.raises(UserError, match="no chair, table or bed"):
        furniture.SweetHomeFurniture(str(tmp_path), Cache(tmp_path / "cache")).credits()


def test_unusable_and_stretched_models_are_reported(tmp_path: Path) -> None:
    lines = entry(1, "Test#chair", "Chair", CHAIR, width="60") | entry(
        2, "Test#deckChair", "Deck chair", CHAIR
    )
    lines |= entry(3, "Test#pool", "Pool table", TABLE) | entry(4, "Test#vase", "Vase", TABLE)
    members = {"models/chair/model.obj": obj(CHAIR), "models/chair/model.mtl": MATERIALS}
    members["PluginFurnitureCatalog.properties"] = "\n".join(f"{k}={v}" for k, v in lines.items())
    path = write_archive(tmp_path / "c.sh3f", members)
    assert [candidate[1:] for candidate in furniture.candidates([path], Cache(tmp_path / "cache"))] == [
        ("chair", "", ("stretched 1.33 times more along one axis than along another",)),
        ("lounger", "procedural homes have no label lounger", ()),
        ("?", "only its name resembles furniture", ()),
    ]


def test_a_rotated_mesh_is_not_rotated_again(tmp_path: Path) -> None:
    turned = {"modelRotation": "0 0 1 0 1 0 -1 0 0"}
    lines = [f"{k}={v}" for k, v in entry(1, "Test#table", "Table", TABLE, **turned).items()]
    path = write_archive(
        tmp_path / "c.sh3f",
        {
            "PluginFurnitureCatalog.properties": "\n".join(lines),
            "models/table/model.obj": obj(TABLE),
            "models/table/model.mtl": MATERIALS,
        },
    )
    (candidate,) = furniture.candidates([path], Cache(tmp_path / "cache"))
    assert (candidate.reason, candidate.notes) == ("", ("the mesh is rotated already",))


# furniture of procedural homes


def test_models_are_prepared_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Unusable models as well, with their reasons and notes."""
    members: dict[str, str | bytes] = {
        "models/flat/model.obj": obj(FLAT),
        "models/glass/model.obj": obj(CHAIR, "glass"),
    }
    lines = entry(1, "Test#flat", "Chair", CHAIR) | entry(2, "Test#glass", "Chair", CHAIR)
    members["models/glass/model.mtl"] = MATERIALS
    members["PluginFurnitureCatalog.properties"] = "\n".join(f"{k}={v}" for k, v in lines.items())
    path = write_archive(tmp_path / "c.sh3f", members)
    first = furniture.candidates([path], Cache(tmp_path / "cache"))
    assert "stretches" in first[0].reason and "transparent" in first[1].notes[0]
    monkeypatch.setattr(furniture, "_prepare_arrays", must_not_prepare)
    assert furniture.candidates([path], Cache(tmp_path / "cache")) == first
    assert not caplog.text


def must_not_prepare(*_: object) -> None:
    raise AssertionError("the cache holds the model")


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> furniture.SweetHomeFurniture:
    folder = tmp_path_factory.mktemp("assets")
    write_catalogue(folder / "Test.sh3f")
    return furniture.SweetHomeFurniture(str(folder), Cache(folder / "cache"))


def test_pieces_have_the_frame_and_size_of_pieces(designed: furniture.SweetHomeFurniture) -> None:
    """x to the right, y to the front, z up: the back of a chair is at -y; the size of the catalogue; on the floor."""
    rng = np.random.default_rng(0)
    chair = designed.piece("chair", "train", Palette(rng), rng)
    np.testing.assert_allclose(chair.low[2], 0, atol=1e-6)
    assert chair.high[2] == pytest.approx(4 * chair.high[0], rel=1e-5)  # 90 cm high, 45 wide
    top = chair.vertices[chair.vertices[:, 2] > 0.6 * chair.high[2]]
    assert top[:, 1].max() < chair.low[1] + 0.2 * (chair.high[1] - chair.low[1])


def test_a_table_has_seats_between_its_legs(designed: furniture.SweetHomeFurniture) -> None:
    rng = np.random.default_rng(0)
    table = designed.piece("dining_table", "train", Palette(rng), rng)
    half = (table.high - table.low)[:2] / 2
    sides = {(round(np.sin(seat.yaw)), round(np.cos(seat.yaw))) for seat in table.seats}
    assert {(0, 1), (0, -1)} <= sides
    for seat in table.seats:
        inward = np.array([-np.sin(seat.yaw), np.cos(seat.yaw)])
        edge = np.array([seat.x, seat.y])
        assert abs(abs(edge @ inward) - half @ np.abs(inward)) < 0.03  # at the edge of the table
        assert edge @ inward < 0 and 0.12 <= seat.depth <= half @ np.abs(inward)
        assert seat.underside == pytest.approx(0.7 * table.high[2] / 0.75, abs=0.01)
    (surface,) = table.surfaces
    assert surface.z == pytest.approx(table.high[2], abs=0.015)


def test_splits_share_no_model(designed: furniture.SweetHomeFurniture) -> None:
    models: dict[str, set[str]] = {split: set() for split in SPLITS}
    for credit in designed.credits():
        models[credit.split].add(credit.model)
        assert (credit.author, credit.licence) == ("Somebody", "CC BY 3.0")
    assert all(models.values()) and sum(map(len, models.values())) == len(set.union(*models.values())) == 12


def test_homes_contain_only_models_of_their_split(
    designed: furniture.SweetHomeFurniture, tmp_path: Path
) -> None:
    table = CategoryTable.from_config(dict(configured(tmp_path).categories))
    homes = ProceduralHomes(0, dict.fromkeys(SPLITS, 1), table, 0.2, ("chair",), designed)
    owner = {credit.model: credit.split for credit in designed.credits()}
    for split in SPLITS:
        scene = homes.load(homes.scenes(split)[0])
        used = {obj.model for obj in scene.objects if "#" in obj.model}
        assert used and {owner[model] for model in used} == {split}
        assert scene.of_category("chair")
    plain = ProceduralHomes(0, dict.fromkeys(SPLITS, 1), table, 0.2)
    assert homes.fingerprint("train_0000") != plain.fingerprint("train_0000")


def test_entries_of_one_size_stay_in_one_split() -> None:
    def make_entry(id: str, width: float) -> object:
        return furniture.Entry(id, "Table", "", "", "m.obj", (width, 0.8, 0.75), (), False, "", "", "a")

    same = furniture.split_designs([make_entry(f"x#{n}", 1 + 0.001 * n) for n in range(9)])  # type: ignore[misc]
    assert list(same) == ["train"]
    different = furniture.split_designs([make_entry(f"x#{n}", 1 + 0.1 * n) for n in range(20)])  # type: ignore[misc]
    assert {split: len(entries) for split, entries in different.items()} == {"train": 12, "val": 3, "test": 5}


def test_missing_archives_are_reported(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"found no \.sh3f archive in .*python -m imagination.assets name=sweethome3d"
    ):
        furniture.find_archives(str(tmp_path))
    write_archive(tmp_path / "a.sh3f", {"readme": "x"})
    with pytest.raises(UserError, match="has no PluginFurnitureCatalog"):
        furniture.candidates(furniture.find_archives(str(tmp_path)), Cache(tmp_path / "cache"))


def test_surrogate_pairs_and_huge_entry_numbers(tmp_path: Path) -> None:
    """Characters beyond 16 bits are two escapes; half a pair and a number of 5000 digits are harmless."""
    lines = [
        f"{key}={value}" for key, value in entry(1, "Test#chair", r"Chair \uD83D\uDE00 \uD83D", CHAIR).items()
    ]
    lines += ["id#" + "9" * 5000 + "=x", "creator#1=Zo\\u00eb"]
    path = write_archive(tmp_path / "c.sh3f", {"PluginFurnitureCatalog.properties": "\n".join(lines)})
    (chair,) = catalogue.read_catalogue(path).entries
    assert (chair.name, chair.creator) == ("Chair \U0001f600 \ufffd", "Zoë")
    chair.name.encode()


def test_a_dangling_symlink_is_reported(tmp_path: Path) -> None:
    (tmp_path / "x.sh3f").symlink_to("nowhere")
    with pytest.raises(UserError, match=r"x\.sh3f|nowhere"):
        furniture.SweetHomeFurniture(str(tmp_path), Cache(tmp_path / "cache")).fingerprint()


# labels


@pytest.mark.parametrize(
    ("text", "size", "label"),
    [
        ("eTeks#officeChair", SIZE, "office_chair"),
        ("eTeks#squareTable", (1.2, 0.8, 0.74), "dining_table"),
        ("Coffee table", (1.2, 0.8, 0.45), "coffee_table"),
        ("Bedside table", (0.4, 0.4, 0.5), "nightstand"),
        ("Bar stool", (0.4, 0.4, 0.8), "stool"),
        ("eTeks#bed140x190", (1.5, 2.0, 0.9), "double_bed"),
        ("Bunk bed", (1.0, 2.0, 1.7), "bunk_bed"),
        ("Pool table", (2.5, 1.4, 0.8), None),
        ("Desk lamp", (0.2, 0.2, 0.4), None),
        ("Wheelchair", SIZE, None),
        ("Light oak chair", SIZE, "chair"),
        ("Scopia#desk_lamp2", (0.2, 0.2, 0.4), None),
        ("Adjustable desk", (1.4, 0.7, 0.75), "desk"),
        ("Adjustable office chair", SIZE, "office_chair"),
        ("Dressing table", (0.9, 0.5, 1.3), "desk"),
        ("Outdoor chair", SIZE, "chair"),
        ("Cot with adjustable height", (0.7, 1.2, 1.1), "cot"),
        ("Deck chair", (0.7, 1.3, 0.8), "lounger"),
        ("Armchair ottoman", (0.8, 1.5, 1.0), "armchair"),
        ("Round ottoman", (0.6, 0.6, 0.4), "stool"),
    ],
)
def test_labels_of_ids_and_english_names(text: str, size: labels.Size, label: str | None) -> None:
    assert labels.label_of([text], size) == label


@pytest.mark.parametrize(
    ("name", "size", "label"),
    [
        ("Stuhl rot", SIZE, "chair"),
        ("Fauteuil", SIZE, "armchair"),
        ("Lit", SIZE, "single_bed"),
        ("椅子", SIZE, "chair"),
        ("Trona", SIZE, "chair"),
        ("Xyz", SIZE, None),
        ("Küchenstuhl", SIZE, "chair"),
        ("Bürostuhl", SIZE, "office_chair"),
        ("Rollstuhl", SIZE, None),
        ("Liegestuhl", (0.7, 1.6, 0.9), "lounger"),
        ("Chaise longue", (0.7, 1.8, 0.8), "lounger"),
        ("Chaise", SIZE, "chair"),
        ("Esstisch", (1.6, 0.9, 0.75), "dining_table"),
        ("Eettafel", (1.6, 0.9, 0.75), "dining_table"),
        ("Ruokapöytä", (1.6, 0.9, 0.75), "dining_table"),
        ("Tischdecke", (1.6, 0.9, 0.01), None),
        ("Schreibtisch", (1.6, 0.8, 0.75), "desk"),
        ("Doppelbett", (1.6, 2.0, 0.9), "double_bed"),
        ("Tweepersoonsbed", (1.6, 2.0, 0.9), "double_bed"),
        ("Nachttisch", (0.4, 0.4, 0.5), "nightstand"),
        ("Table de chevet", (0.4, 0.4, 0.5), "nightstand"),
        ("床头柜", (0.4, 0.4, 0.5), "nightstand"),
        ("床", (1.6, 2.0, 0.9), "double_bed"),
    ],
)
def test_labels_of_names_in_any_language(name: str, size: labels.Size, label: str | None) -> None:
    assert labels.label_of_name(name, {"trona": "chair"}, size) == label


# homes


def write_invalid(tmp_path: Path, members: dict[str, str | bytes]) -> Path:
    return write_archive(tmp_path / "invalid.sh3d", members)


ENTITIES = "<!DOCTYPE home [<!ENTITY a 'aaaa'><!ENTITY b SYSTEM 'file:///etc/passwd'>]><home>&b;</home>"


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"Home": b"\xac\xed"}, "before 5.3"),
        ({"other": "x"}, "expected a home of Sweet Home 3D"),
        ({"Home.xml": "<home><wall"}, "is damaged"),
        ({"Home.xml": "<house/>"}, "holds <house>, expected <home>"),
        ({"Home.xml": ENTITIES}, "declares a document type"),
        ({"Home.xml": home_xml(walls(0, 0, 500, 400))}, "none of 1 levels has furniture"),
        ({"Home.xml": home_xml(furnished().replace('width="45"', 'width="nan"'))}, "width: got 'nan'"),
        ({"Home.xml": home_xml(furnished().replace('xStart="0"', "", 1))}, "<wall> has no xStart"),
        ({"Home.xml": home_xml(furnished().replace('y="250"', 'y="1e9"', 1))}, "y: got '1e9'"),
        ({"Home.xml": "<?xml version='1.0' encoding='nonsense'?><home/>"}, "is damaged: unknown encoding"),
        (
            {"Home.xml": "<?xml version='1.0' encoding='shift_jis'?><home/>"},
            "is damaged: multi-byte encodings",
        ),
        ({"Home.xml": "<?xml version='1.0' encoding='utf-7'?><home/>"}, "is damaged: "),
        ({"Home.xml": home_xml("<point/>" * (home_file.MAX_ITEMS + 1))}, "got 20001 levels"),
    ],
)
def test_an_invalid_home_is_reported(tmp_path: Path, members: dict[str, str | bytes], message: str) -> None:
    with pytest.raises(UserError, match=message):
        home_file.read_home(write_invalid(tmp_path, members))


def test_pieces_get_a_label_and_a_model(tmp_path: Path) -> None:
    """Labels by the catalogue, by words of the id, by the name; drawn with the model or as a box."""
    write_catalogue(tmp_path / "assets" / "Test.sh3f")
    write_home(tmp_path / "homes" / "flat.sh3d")
    homes = source(
        tmp_path,
        "data/scenes=sweethome3d",
        f"data.scenes.folder={tmp_path}/homes",
        f"data.scenes.catalogues={tmp_path}/assets",
    )
    chair, table, bed = homes.piece_reports("flat")  # type: ignore[attr-defined]
    assert (chair.label, chair.label_source, chair.drawn_as) == ("chair", "catalogue", "its model")
    assert (table.label, table.label_source) == ("dining_table", "name") and table.drawn_as.startswith(
        "a box"
    )
    assert (bed.label, bed.label_source) == ("double_bed", "id")
    scene = homes.load("flat")
    x, y, z = scene.of_category("chair")[0].box.centre
    assert (x, y, z) == pytest.approx((1.0, -2.5, 0.45), abs=1e-5)
    # the back of the bed is at the top of the plan, +y here
    mesh = scene.mesh
    instance = scene.of_category("bed")[0].instance
    points = mesh.vertices[mesh.faces[mesh.face_instance == instance]].reshape(-1, 3)
    assert points[points[:, 2] > 0.6][:, 1].min() > points[:, 1].max() - 0.1


def homes_of(folder: Path, inside: str, **members: str) -> home_source.SweetHomes:
    """Write a folder with one home, and return its scene source."""
    write_catalogue(folder / "assets" / "Test.sh3f")
    write_home(folder / "homes" / "flat.sh3d", inside, members)
    homes = source(
        folder,
        "data/scenes=sweethome3d",
        f"data.scenes.folder={folder}/homes",
        f"data.scenes.catalogues={folder}/assets",
    )
    assert isinstance(homes, home_source.SweetHomes)
    return homes


def test_a_home_without_free_space_is_reported(tmp_path: Path) -> None:
    home = homes_of(tmp_path, furnished())
    home._robot_radius = 5.0
    with pytest.raises(UserError, match=r"scene flat of .*flat\.sh3d: free space: .*radius 5\.0 m"):
        home.load("flat")


BENCH: tuple[Box, ...] = (
    (0, 0, 0, 40, 40, 90),
    (0, 40, 0, 40, 100, 5),  # a back
    (0, 40, 5, 5, 70, 90),  # an arm rest at the left
)


@pytest.mark.parametrize(
    ("attributes", "height", "corners"),
    [
        ({}, 70, {(-20, -40), (-15, -40), (-20, 45), (-15, 45)}),
        ({"modelMirrored": "true"}, 70, {(20, -40), (15, -40), (20, 45), (15, 45)}),
        (  # on its back: the front is on top
            {"pitch": "1.5707963267948966"},
            90,
            {(-20, 50), (20, 50), (-20, 10), (20, 10), (-15, 10), (-20, -20), (-15, -20)},
        ),
        (  # on its right side: the left side is on top
            {"roll": "1.5707963267948966"},
            40,
            {
                (-50, -45),
                (-50, 45),
                (-10, -45),
                (-10, 45),
                (50, -45),
                (50, -40),
                (-10, -40),
                (20, -40),
                (20, 45),
            },
        ),
    ],
)
def test_a_piece_has_its_pose_on_the_plan(
    tmp_path: Path, attributes: dict[str, str], height: float, corners: set[tuple[float, float]]
) -> None:
    """Corners at a height above the bottom, relative to the centre to the right and to the front, set by hand.

    Sweet Home 3D rotates them clockwise on the plan, whose y points down.
    """
    bench = piece(
        "", "Bench", 200, 150, (40, 90, 100), model="b.obj", angle="0.5", elevation="30", **attributes
    )
    homes = homes_of(tmp_path, walls(0, 0, 500, 400) + bench, **{"b.obj": obj(BENCH), "model.mtl": MATERIALS})
    mesh = homes.load("flat").mesh
    points = mesh.vertices[np.unique(mesh.faces[mesh.face_instance == 1])]
    actual = {
        (round(float(x), 3), round(float(y), 3)) for x, y, z in points if abs(z - 0.3 - height / 100) < 1e-5
    }
    cos, sin = np.cos(0.5), np.sin(0.5)
    on_plan = [(200 + x * cos - y * sin, 150 + x * sin + y * cos) for x, y in corners]
    assert actual == {(round(float(x) / 100, 3), round(-float(y) / 100, 3)) for x, y in on_plan}
    assert points[:, 2].min() == pytest.approx(0.3)


def test_a_model_is_read_once_and_too_many_triangles_become_boxes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chairs = [piece("", "Chair", 100 * x, 100, (45, 45, 90 + x), model="0/model.obj") for x in (1, 2, 3)]
    homes = homes_of(tmp_path, walls(0, 0, 500, 400) + "".join(chairs))
    read: list[str] = []
    reader = home_source.read_model
    monkeypatch.setattr(home_source, "read_model", lambda *args: read.append(args[1]) or reader(*args))
    assert [report.drawn_as for report in homes.piece_reports("flat")] == ["its model"] * 3
    assert read == ["0/model.obj"]
    monkeypatch.setattr(home_source, "MAX_TRIANGLES", 100)  # a chair has 72
    assert [report.drawn_as for report in homes.piece_reports("flat")][1:] == [
        "its model",
        "a box: earlier pieces of the level have more than 100 triangles",
    ]


def test_too_many_walls_and_openings_are_refused(tmp_path: Path) -> None:
    door = '<doorOrWindow name="Door" x="{}" y="0" width="0.1" depth="10" height="{}"/>'
    doors = "".join(door.format(number, 1 + number / 10) for number in range(1, 300))
    chair = piece("", "Chair", 100, 100, (45, 45, 90))
    for copies, message in (
        (1, "got more than 50000 boxes around 299 doors"),
        (1000, "got 4000 walls and 299 doors"),
    ):
        inside = walls(0, 0, 500, 400) * copies + chair + doors
        (level,) = home_file.read_home(write_home(tmp_path / "h.sh3d", inside))
        with pytest.raises(UserError, match=message):
            build_shell(level)


def test_homes_credit_the_authors_of_their_models(tmp_path: Path) -> None:
    """Authors come from the catalogue or the file; the fingerprint includes the content of the catalogue."""
    own = piece("", "Tisch", 300, 200, (90, 90, 75), model="t.obj", creator="Ann", license="CC0")
    homes = homes_of(tmp_path, furnished() + own)
    assert homes.credits() == [
        ("train", "chair", "Test#chair1", "Somebody", "CC BY 3.0", "Test.sh3f"),
        ("train", "dining_table", "t.obj", "Ann", "CC0", "flat.sh3d"),
    ]
    before = homes.fingerprint("flat")
    assert homes.fingerprint("flat") == before
    archive = tmp_path / "assets" / "Test.sh3f"
    archive.write_bytes(archive.read_bytes() + b" ")
    os.utime(archive, (0, 0))
    assert homes.fingerprint("flat") != before
    (tmp_path / "homes" / "flat.sh3d").write_text("broken")
    assert homes.credits() == []


def test_a_door_is_open_and_a_window_is_closed(tmp_path: Path) -> None:
    write_home(tmp_path / "homes" / "flat.sh3d")
    homes = source(tmp_path, "data/scenes=sweethome3d", f"data.scenes.folder={tmp_path}/homes")
    mesh = homes.load("flat").mesh
    corners = mesh.vertices[mesh.faces][mesh.face_instance == 0]
    middle = corners.mean(axis=1)
    in_door = (np.abs(middle[:, 0] - 2.5) < 0.4) & (np.abs(middle[:, 1]) < 0.04) & (middle[:, 2] < 2.0)
    assert not (in_door & (middle[:, 2] > 0.01)).any()
    in_window = (
        (np.abs(middle[:, 0]) < 0.03)
        & (np.abs(middle[:, 1] + 2.0) < 0.4)
        & (np.abs(middle[:, 2] - 1.4) < 0.4)
    )
    assert in_window.any()


LEVELS = '<level id="L0" name="Ground" elevation="0" height="250"/>'
LEVELS += '<level id="L1" name="First" elevation="262" height="250"/>'
TWO_LEVELS = LEVELS + furnished("L0") + furnished("L1")


def test_each_furnished_level_is_a_scene(tmp_path: Path) -> None:
    attic = '<level id="L2" name="Attic" elevation="524"/>' + walls(0, 0, 9, 9, "L2")
    write_home(tmp_path / "homes" / "house.sh3d", TWO_LEVELS + attic)
    write_home(tmp_path / "homes" / "house_7.sh3d")  # the other home has no level 7
    homes = source(tmp_path, "data/scenes=sweethome3d", f"data.scenes.folder={tmp_path}/homes")
    assert sorted(homes.scenes("train") + homes.scenes("test")) == ["house_0", "house_1", "house_7"]
    upper = homes.load("house_1")
    assert (upper.floor_height, upper.ceiling_height) == pytest.approx((2.62, 5.12))
    assert upper.mesh.vertices[:, 2].min() == pytest.approx(2.62, abs=1e-5)


def test_groups_mirrored_models_and_hidden_pieces(tmp_path: Path) -> None:
    chair = piece("", "Chair", 100, 100, (45, 45, 90), model="0/model.obj", modelMirrored="true")
    hidden = piece("", "Chair", 300, 300, (45, 45, 90), visible="false")
    group = f'<furnitureGroup name="set">{chair}{hidden}</furnitureGroup>'
    path = write_home(tmp_path / "h.sh3d", walls(0, 0, 500, 400) + group)
    (level,) = home_file.read_home(path)
    assert [(item.name, item.mirrored) for item in level.furniture] == [("Chair", True)]


def test_groups_may_be_nested_deeply(tmp_path: Path) -> None:
    deep = "<furnitureGroup>" * 3000 + piece("", "Chair", 100, 100, (45, 45, 90)) + "</furnitureGroup>" * 3000
    (level,) = home_file.read_home(write_home(tmp_path / "h.sh3d", walls(0, 0, 500, 400) + deep))
    assert [item.name for item in level.furniture] == ["Chair"]


def test_items_without_a_level_are_on_the_ground_floor(tmp_path: Path) -> None:
    levels = '<level id="C" name="Cellar" elevation="-250"/><level id="G" name="Ground" elevation="0"/>'
    inside = levels + walls(0, 0, 500, 400) + piece("", "Chair", 100, 100, (45, 45, 90), level="gone")
    group = f'<furnitureGroup level="C">{piece("", "Table", 100, 100, (90, 90, 70))}</furnitureGroup>'
    cellar, ground = home_file.read_home(
        write_home(tmp_path / "h.sh3d", inside + walls(0, 0, 500, 400, "C") + group)
    )
    assert (len(ground.walls), len(ground.rooms), [item.name for item in ground.pieces]) == (4, 1, ["Chair"])
    assert [item.name for item in cellar.pieces] == ["Table"]


def test_an_arc_bends_away_from_its_chord() -> None:
    points = home_file._along_arc(np.zeros(2), np.array([2.0, 0.0]), np.pi)
    np.testing.assert_allclose(np.hypot(*(np.array(points) - [1, 0]).T), 1.0)
    assert len(points) == 9 and points[4][1] > 0.99  # counter-clockwise on the plan, whose y points down


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: None, r"data\.scenes\.folder: .*does not exist"),
        (lambda folder: folder.mkdir(), "found no .sh3d file in"),
        (lambda folder: write_home(folder / "a.sh3d"), "split val: found no homes"),
        (
            lambda folder: [write_home(folder / d / "a.sh3d") for d in ("train", "val")],
            "homes: got .*named a in",
        ),
        (
            lambda folder: [
                write_home(folder / "train/a.sh3d", TWO_LEVELS),
                write_home(folder / "val/a_0.sh3d"),
            ],
            "homes: got .*'a_0'.*train/a.sh3d.*val/a_0.sh3d",
        ),
        (
            lambda folder: [(folder / "val").mkdir(parents=True), (folder / "val/x.sh3d").symlink_to("gone")],
            r"x\.sh3d: does not exist",
        ),
    ],
)
def test_a_wrong_folder_is_reported(tmp_path: Path, make: object, message: str) -> None:
    make(tmp_path / "homes")  # type: ignore[operator]
    with pytest.raises(UserError, match=message):
        homes = source(tmp_path, "data/scenes=sweethome3d", f"data.scenes.folder={tmp_path}/homes")
        homes.scenes("val")


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(Exception, match=r"data\.scenes\.folder: got null"):
        source(tmp_path, "data/scenes=sweethome3d")

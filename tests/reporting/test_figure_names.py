"""File names of figures."""

from hypothesis import given
from hypothesis import strategies as st

from imagination.reporting.figures.file_names import MAX_LENGTH, safe_names


@given(st.lists(st.text(max_size=80), max_size=12))
def test_names_are_safe_and_distinct_on_any_file_system(stems: list[str]) -> None:
    names = safe_names(stems)
    assert set(names) == set(stems)
    assert len({name.lower() for name in names.values()}) == len(set(stems))
    for name in names.values():
        assert len(name) <= MAX_LENGTH and not set(name) & set('/\\\0:*?"<>|\n')


def test_usual_names_stay() -> None:
    stems = ["maps_chair", "ablation_kernels.imaginable_chair"]
    assert safe_names(stems) == dict(zip(stems, stems, strict=True))
    assert safe_names(["a/b", "a_b"])["a/b"] != "a_b"
    assert safe_names(["maps_Chair", "maps_chair"])["maps_Chair"] == "maps_Chair"


def test_a_name_with_a_hash_of_another_is_changed() -> None:
    hashed = safe_names(["a b"])["a b"]
    names = safe_names([hashed, "a b"])
    assert len(set(names.values())) == 2

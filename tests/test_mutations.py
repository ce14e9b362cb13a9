"""The list of mutations follows the code; `make mutate`, which takes long, tries them."""

import pytest

from tests.conftest import ROOT
from tests.mutations import MUTATIONS, Mutation


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.what)
def test_what_a_mutation_changes_is_there(mutation: Mutation) -> None:
    folder = ROOT if mutation.file.startswith("plugins/") else ROOT / "imagination"
    assert (folder / mutation.file).read_text().count(mutation.old) == 1
    assert all((ROOT / word).exists() for word in mutation.tests.split() if word.startswith("tests/"))

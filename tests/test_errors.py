"""Messages that refuse a name suggest the nearest one that is known."""

from __future__ import annotations

import pytest

import whitefurnace
from whitefurnace.errors import UsageError, nearest

NAMES = ["ggx", "beckmann", "NoV", "nov_table", "min_size", "schlick_f82"]


@pytest.mark.parametrize(
    "given, meant",
    [
        ("GGX", "ggx"),
        ("Beckman", "beckmann"),
        ("BECKMANN", "beckmann"),
        ("nov", "NoV"),
        ("NOV", "NoV"),
        ("min-size", "min_size"),
        ("Min Size", "min_size"),
        ("Schlick-F82", "schlick_f82"),
    ],
)
def test_case_and_joints_of_words_do_not_count(given, meant):
    assert nearest(given, NAMES) == f"; did you mean {meant!r}?"


def test_of_names_that_differ_by_case_alone_the_closest_is_meant():
    assert nearest("Nov", ["NOV", "NoV", "nov"]) == "; did you mean 'NoV'?"


def test_what_is_like_nothing_lists_all():
    assert nearest("xyz", NAMES[:3]) == "; known: NoV, beckmann, ggx" and nearest("xyz", []) == "; there is none"


@pytest.mark.parametrize(
    "given, meant",
    [
        ({"ndf": "GGX", "NoV": 0.5, "alpha": 0.3}, "unknown ndf 'GGX'; did you mean 'ggx'"),
        ({"ndf": "ggx", "nov": 0.5, "alpha": 0.3}, "no parameter 'nov'; did you mean 'NoV'"),
        ({"ndf": "ggx", "NoV": 0.5, "Alpha": 0.3}, "no parameter 'Alpha'; did you mean 'alpha'"),
        ({"ndf": "ggx", "NoV": 0.5, "alpha": 0.3, "tolerence": 1e-3}, "'tolerence'; did you mean 'tolerance'"),
        ({"ndf": "ggx", "NoV": 0.5, "alpha": 0.3, "masking": "Smith"}, "unknown masking 'Smith'; did you mean 'smith'"),
        ({"ndf": "ggx", "NoV": 0.5, "alpha": 0.3, "fresnel": "schlick:Gold"}, "'Gold'; did you mean 'gold'"),
    ],
)
def test_integrate_suggests_names_and_keywords(given, meant):
    with pytest.raises(UsageError, match=meant):
        whitefurnace.integrate("albedo", **given)


@pytest.mark.parametrize(
    "argv, meant",
    [
        (["lut", "DFG", "-o", "a.npy"], "did you mean 'dfg'"),
        (["lut", "dfg", "--ndf", "GGX", "-o", "a.npy"], "did you mean 'ggx'"),
        (["lut", "dfg", "--axis", "nov=0:1:8", "-o", "a.npy"], "did you mean 'NoV'"),
        (["bake", "demo", "-o", "out", "--for", "Three"], "did you mean 'three'"),
        (["bake", "demo", "-o", "out", "--sh", "window=Auto"], "did you mean 'auto'"),
        (["models", "GGX"], "did you mean 'ggx'"),
        (["engines", "THREE"], "did you mean 'three'"),
        (["bench", "Anterpolate"], "did you mean 'anterpolate'"),
        (["verify", "GGX"], "did you mean 'ggx'"),
    ],
)
def test_commands_suggest_names(shell, tmp_path, monkeypatch, argv, meant):
    monkeypatch.chdir(tmp_path)
    assert shell(*argv) == 1
    assert meant in shell.sentence()

"""A command that was killed in its first step is run again by the same command."""

import pytest

from tcpipe.experiment import reproduction
from tcpipe.pipeline import demo


class _Begun(Exception):  # noqa: N818
    pass


@pytest.mark.parametrize(
    ("module", "run"),
    [
        (demo, lambda place: demo.run_demo(place, seed=1, begin_part=lambda *_, **__: None)),
        (reproduction, lambda place: reproduction.reproduce(place, size="quick")),
    ],
)
def test_what_a_killed_simulation_left_is_in_nobodys_way(module, run, tmp_path, monkeypatch):
    def begin(*_, **__):
        raise _Begun

    monkeypatch.setattr(module, "simulate", begin)
    (tmp_path / ".tmp-site-0123abcd" / "site").mkdir(parents=True)
    with pytest.raises(_Begun):
        run(tmp_path)

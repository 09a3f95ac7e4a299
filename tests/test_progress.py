"""What long calls tell of their progress."""

import builtins

import pytest

from shisd._progress import reporting


def test_functions_are_told_every_step_up_to_the_last():
    told = []
    with reporting(lambda *now: told.append(now), 5, "steps") as step:
        step()
        step(3)
        step()
    assert told == [(1, 5), (4, 5), (5, 5)]


@pytest.mark.parametrize("silent", [None, False])
def test_nothing_is_told_unasked(silent, capsys):
    with reporting(silent, 2, "steps") as step:
        step(2)
    assert capsys.readouterr() == ("", "")


def test_true_is_a_bar(capsys):
    with reporting(True, 4, "rays") as step:
        step(4)
    assert "rays: 100%" in capsys.readouterr().err


def test_what_it_raises_ends_the_call():
    def stop(done, total):
        raise KeyboardInterrupt(f"{done} of {total}")

    with pytest.raises(KeyboardInterrupt, match="1 of 2"), reporting(stop, 2, "steps") as step:
        step()


def test_errors_say_what_to_pass(monkeypatch, as_user):
    with pytest.raises(ValueError, match="`progress` must be None, True, or a function of done and total; got 3"):
        with reporting(3, 1, "steps"):
            pass
    real = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", lambda name, *a: real(name if name != "tqdm" else "no_tqdm", *a))
    with pytest.raises(ImportError, match="`progress=True` needs the package tqdm: pip install tqdm"):
        with reporting(True, 1, "steps"):
            pass

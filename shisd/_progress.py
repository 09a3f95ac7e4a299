"""Progress of long calls, told to the caller: a bar of tqdm, or any function.

A call that takes it has `progress`: None, nothing is told; True, a bar of the package tqdm; or a function
`progress(done, total)` that is called after every step, at last with done = total. What it raises ends the call.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from typing_extensions import TypeAliasType

Progress = TypeAliasType("Progress", Callable[[int, int], object] | bool | None)


@contextmanager
def reporting(progress: Progress, total: int, label: str) -> Iterator[Callable[..., object]]:
    """A function `step(count=1)` to call on the host when so many more of `total` steps are done.

    ValueError for another `progress`; ImportError for True without tqdm.
    """
    if progress is None or progress is False:
        yield lambda count=1: None
    elif progress is True:
        try:
            from tqdm import tqdm
        except ImportError as error:
            raise ImportError("`progress=True` needs the package tqdm: pip install tqdm.") from error
        with tqdm(total=total, desc=label) as bar:
            yield bar.update
    elif callable(progress):
        done = 0

        def step(count: int = 1) -> None:
            nonlocal done
            done += count
            progress(done, total)

        yield step
    else:
        raise ValueError(f"`progress` must be None, True, or a function of done and total; got {progress!r}.")

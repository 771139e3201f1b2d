"""The one place that talks to pybullet's global state."""

import functools
from typing import Any

import pybullet


class Client:
    """A headless physics world; every pybullet call goes through it with its own id.

    A call that leaves the id out acts on world 0 without a word, so nobody else makes one.
    """

    def __init__(self) -> None:
        self.id = pybullet.connect(pybullet.DIRECT)  # GUI would end the process without a display
        if self.id < 0:
            raise RuntimeError(
                "pybullet opened no further world (about 1000 fit in one process); "
                "close() the environments that you no longer use."
            )

    def __getattr__(self, name: str) -> Any:
        """Return pybullet's function of that name, bound to this world."""
        if name == "id" or name.startswith("__"):  # else copying a Client would recurse
            raise AttributeError(name)
        function = functools.partial(getattr(pybullet, name), physicsClientId=self.id)
        setattr(self, name, function)  # the next look-up does not come here
        return function

    def close(self) -> None:
        """Free the world (about 30 MB); safe to call twice."""
        if self.id >= 0:
            pybullet.disconnect(physicsClientId=self.id)
            self.id = -1

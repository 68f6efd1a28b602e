"""Values of the touches that the tests of `view` show, and a camera that is pressed."""

import time

import numpy as np
from press_videos import gel_frame

SCRIPT = "<script>document.title = 'broken'</script><img src=x onerror=alert(1)>"
DEPTHS = (0, 60, 90)  # of the frames of each recording


class PressCamera:
    """A camera at 30 frames/s of a gel that is pressed by `shape`: "ball", "bar", "pins", or "" for
    nothing.
    """

    def __init__(self) -> None:
        self.shape = ""
        self._count = 0
        self._due = 0.0
        self._frames = {
            shape: [
                gel_frame("coloured", 0.9 * bool(shape), shape or "ball", i - 6, i)[..., ::-1]
                for i in range(12)
            ]
            for shape in ("", "ball", "bar", "pins")
        }

    def grab(self) -> bool:
        self._due = max(self._due + 1 / 30, time.perf_counter() - 1 / 30)
        time.sleep(max(0.0, self._due - time.perf_counter()))
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        self._count += 1
        return True, self._frames[self.shape][self._count % 12]

    def release(self) -> None:
        pass

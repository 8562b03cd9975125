"""The name of a keyframe."""


class KeyframeId(int):
    """Names a keyframe among those of several sessions: a number with the session above the lower 40 bits.

    In session 0 it is the index itself. As text it is `12`, or with another session `1/12`.
    """

    def __new__(cls, session: int, index: int) -> "KeyframeId":
        return super().__new__(cls, session << 40 | index)

    @property
    def session(self) -> int:
        return self >> 40

    @property
    def index(self) -> int:
        return self & ((1 << 40) - 1)

    def __getnewargs__(self) -> tuple[int, int]:  # type: ignore[override]  # of `int`, which takes one
        return self.session, self.index

    def __str__(self) -> str:
        return f"{self.session}/{self.index}" if self.session else str(self.index)

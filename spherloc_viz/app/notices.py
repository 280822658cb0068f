"""What a page is told of the recordings, though nobody asked: one notification with the newest word, one of failure."""

import threading

import viser

SHOWN_S = 15.0


class Notices:
    """One client's."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._shown: viser.NotificationHandle | None = None
        self._failure: viser.NotificationHandle | None = None
        self._lock = threading.Lock()

    def show(self, sentence: str) -> None:
        """Show a sentence for a while."""
        with self._lock:
            if self._shown is not None:
                self._shown.remove()
            self._shown = self._client.add_notification(
                "Recordings", sentence, color="blue", auto_close_seconds=SHOWN_S
            )

    def fail(self, sentence: str) -> None:
        """Say that runs are not recorded, in place of what was said of that before, until somebody closes it."""
        with self._lock:
            if self._failure is not None:
                self._failure.remove()
            self._failure = self._client.add_notification("Not recorded", sentence, color="red")

    def recover(self, sentence: str) -> None:
        """Say that runs are recorded again."""
        with self._lock:
            if self._failure is not None:
                self._failure.remove()
                self._failure = None
        self.show(sentence)

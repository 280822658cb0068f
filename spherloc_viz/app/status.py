"""The status line of a page: what it is doing, or what went wrong, in one sentence."""

import logging
import threading
from html import escape

import viser

from spherloc.errors import SpherlocError
from spherloc_viz.app.review.filters import keep_html
from spherloc_viz.app.text import DIM, begun, box, status_html
from spherloc_viz.app.web.viser_internals import update_widget
from spherloc_viz.given_files import RECORDING

log = logging.getLogger(__name__)


class Status:
    """One client's status line and notification."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._line = client.gui.add_html(_line_html("Solving the first problem …"))
        self._complaint: tuple[str, viser.NotificationHandle] | None = None
        self._lasting = False
        self._lock = threading.Lock()
        self._said: tuple[str, str] = "", ""
        """What is shown, as HTML, and what is shown in its place while answers are hidden."""
        self._hidden = False

    def say(self, sentence: str, keep: str = "", untold: str = "") -> None:
        """Show what the page is doing; ``keep`` is the file of a recording that gets a button to keep it, and
        ``untold`` the sentence while answers are hidden, if the other one tells of them."""
        with self._lock:
            self._said = _line_html(sentence, keep=keep), _line_html(untold or sentence, keep=keep)
            update_widget(self._line, content=self._said[self._hidden])

    def hide_answers(self, hidden: bool) -> None:
        """Hide the answers in what is said, or show them again."""
        with self._lock:
            before, self._hidden = self._said[self._hidden], hidden
            if self._line.content == before:  # and no complaint
                update_widget(self._line, content=self._said[hidden])

    def complain(self, sentence: str, lasting: bool = False) -> None:
        """Show one sentence about what went wrong; the page keeps its last run and stays usable. A ``lasting`` one is
        about something else than the settings of the page, so that it stays though these are right."""
        sentence = begun(sentence)
        with self._lock:
            self._lasting = lasting
            self._line.content = _line_html(sentence, wrong=True)
            if self._complaint is not None:
                if self._complaint[0] == sentence:
                    return
                self._complaint[1].remove()
            note = self._client.add_notification("Cannot do that", sentence, color="red")
            self._complaint = (sentence, note)

    def fail(self, error: Exception) -> None:
        """Complain about an error: a user's mistake by its own sentence, a bug by one that says so."""
        if isinstance(error, SpherlocError):
            self.complain(str(error))
            return
        log.error("client %s", self._client.client_id, exc_info=error)
        self.complain(f"This is a bug in the playground ({error!r}); change a setting or reload the page.")

    def withdraw(self, another: bool) -> None:
        """The page's settings are right: take away the sentence about an error, a lasting one only if ``another`` run
        has come."""
        with self._lock:
            if self._complaint is not None and (another or not self._lasting):
                self._complaint[1].remove()
                self._complaint = None


TAIL = 20
"""Letters of a recording's name that are shown at its end: estimator, seed, and what makes it unique."""


def _line_html(sentence: str, wrong: bool = False, keep: str = "") -> str:
    """As high as two lines, so that widgets below do not move under the pointer. ``touch.css`` cuts a longer sentence,
    which is whole under a resting pointer, and the name of a recording at its end in the middle, so that both what it
    begins with and what it ends with are seen; what went wrong is shown whole."""
    button = f'<div class="words" style="float:right;padding:.2em .8em 0 .4em">{keep_html(keep)}</div>' if keep else ""
    kind = "" if wrong else ' class="two-lines"'
    look = f'title="{escape(sentence)}" style="font-size:12px;min-height:3.4em"'
    before, _, name = sentence.rpartition(" ")
    if wrong or not name.endswith(RECORDING):
        return f"<div{kind} {look}>{button}{status_html(sentence, wrong)}</div>"
    parts = "".join(f"<span>{escape(part)}</span>" for part in (name[:-TAIL], name[-TAIL:]))
    words = f'{escape(before)} <span class="file-name">{parts}</span>'
    return f"<div {look}>{button}{box(words, f'font-size:12px;display:flow-root;{DIM}')}</div>"


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

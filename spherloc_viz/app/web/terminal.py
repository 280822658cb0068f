"""What a hostile page or request makes the libraries print: a line at most, where it would be a traceback each."""

import asyncio
import logging
import traceback
import warnings
from typing import Any

from aiohttp.http_exceptions import HttpProcessingError

log = logging.getLogger(__name__)


def keep_tracebacks_short() -> None:
    """Have requests that are none pass in silence, and a page that sends what is no message told in a line."""
    logging.getLogger("aiohttp.server").addFilter(_is_news)
    logging.getLogger("websockets.server").addFilter(_in_short)
    warnings.filterwarnings("ignore", message=r"\[viser\] .* does not match annotation")


def tell_in_short(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """A loop's exception handler: a line of what a page's message raised, unless the error is ours."""
    error = context.get("exception")
    if isinstance(error, Exception) and not _is_ours(error):
        log.warning("a page sent a value that is none; it was left out (%s).", type(error).__name__)
    else:
        loop.default_exception_handler(context)


def _is_news(record: logging.LogRecord) -> bool:
    """Not what was answered with a 400 already, nor that the other side has gone."""
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, HttpProcessingError | ConnectionError)


def _in_short(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    if isinstance(error, Exception) and not _is_ours(error):
        record.levelno, record.levelname, record.args, record.exc_info = logging.WARNING, "WARNING", (), None
        record.msg = f"a page was cut off, since what it sent is no message of a page ({type(error).__name__})."
    return True


def _is_ours(error: Exception) -> bool:
    return any("spherloc_viz" in frame.filename for frame in traceback.extract_tb(error.__traceback__))

"""Turns away uploads that are too large while they arrive; viser itself would collect them in memory without a limit.

This leans on viser's insides, as ``viser_internals`` does.
"""

from collections.abc import Callable
from typing import Any

import viser
from viser import _messages

MOST_AT_ONCE = 2
"""Files on their way."""
LEAST_PART_BYTES = 4096
"""The page sends parts of half a megabyte; far smaller ones would fill the memory with their bookkeeping."""


def limit_uploads(client: viser.ClientHandle, most_bytes: int, complain: Callable[[str], None]) -> None:
    """Drop files of more than ``most_bytes``, whether the page says so or just sends more; tell ``complain`` why."""
    gui, connection = client.gui, client._websock_connection
    begin, add = gui._handle_file_transfer_start, gui._handle_file_transfer_part
    under_way = gui._current_file_upload_states

    def refuse(message: Any, sentence: str) -> None:
        # Else the page would wait for ever, with its button disabled.
        ack = _messages.FileTransferPartAck(message.source_component_uuid, message.transfer_uuid, 1, 1)
        connection.queue_message(ack)
        complain(sentence)

    def checked_begin(client_id: Any, message: Any) -> None:
        parts = max(1, most_bytes // LEAST_PART_BYTES)
        if not (0 <= message.size_bytes <= most_bytes and 0 <= message.part_count <= parts):
            refuse(message, f"the file is larger than {most_bytes / 1e6:.2g} MB; upload a smaller one.")
        elif len(under_way) >= MOST_AT_ONCE:
            refuse(message, "two files are on their way already; wait for them.")
        else:
            begin(client_id, message)

    def checked_add(client_id: Any, message: Any) -> None:
        state = under_way.get(message.transfer_uuid)
        if state is not None and state["transferred_bytes"] + len(message.content) > state["total_bytes"]:
            under_way.pop(message.transfer_uuid, None)
            refuse(message, "the file is larger than it said; upload it again.")
            return
        add(client_id, message)

    handlers: Any = (
        (_messages.FileTransferStartUpload, begin, checked_begin),
        (_messages.FileTransferPart, add, checked_add),
    )
    for kind, original, checked in handlers:
        connection.unregister_handler(kind, original)
        connection.register_handler(kind, checked)

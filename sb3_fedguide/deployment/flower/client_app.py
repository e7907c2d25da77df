"""Flower's ClientApp: hands a message to the client's site, whose state is on this machine's own disk."""

from __future__ import annotations

import json
import traceback
from pathlib import Path

from flwr.app import Context
from flwr.app import Message as FlowerMessage
from flwr.clientapp import ClientApp

from sb3_fedguide.deployment.flower.records import from_records, to_records
from sb3_fedguide.deployment.site import SITE, make_site
from sb3_fedguide.deployment.transport import Failure, Message

#: In the client's folder from the federation's end on.
FINISHED = "finished"

app = ClientApp()


@app.train()
def answer(message: FlowerMessage, context: Context) -> FlowerMessage:
    """Answer one message. Of an exception, only the name of its type leaves this machine."""
    reply: Message | Failure
    try:
        request = from_records(message.content)
        if isinstance(request, Failure):
            raise ValueError(f"the server sent a failure: {request.reason}")
        settings = json.loads(Path(str(context.node_config["config"])).read_text(encoding="utf-8"))
        reply = make_site(settings["site"], Path(settings["folder"]) / SITE).handle(request)
        if request.kind == "finish":
            (Path(settings["folder"]) / FINISHED).touch()
    except Exception as error:
        traceback.print_exc()
        reply = Failure.of(error)
    return FlowerMessage(to_records(reply), reply_to=message)

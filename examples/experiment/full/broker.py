"""A real MQTT broker on loopback, with counts of the bytes that it carries."""

from __future__ import annotations

import shutil
import subprocess
from collections import Counter
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt

from tests.e2e.rig import launch
from tests.e2e.rig.net import accepts, free_port
from tests.kit.limits import PATIENCE_S
from tests.kit.rig import wait_until


class Broker:
    """A mosquitto, and a client that counts the bytes of each topic."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.bytes: Counter[str] = Counter()
        program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
        assert program, "mosquitto is missing; run `setup/system e2e` as root to install it"
        configuration = folder / "mosquitto.conf"
        configuration.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n")
        with (folder / "mosquitto.log").open("w") as log:
            self._process = subprocess.Popen(
                launch.command(program, "-c", str(configuration)), stdout=log, stderr=log
            )
        self._counter = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self._counter.on_connect = lambda client, *_: client.subscribe("#")
        self._counter.on_message = self._count
        answers = accepts(self.port)
        wait_until(lambda: answers() is None or self._process.poll() is not None, "mosquitto")
        self._counter.connect("127.0.0.1", self.port)
        self._counter.loop_start()

    def _count(self, _: object, __: object, message: Any) -> None:
        self.bytes[message.topic] += len(message.payload)

    def close(self) -> None:
        self._counter.disconnect()
        self._counter.loop_stop()
        self._process.terminate()
        self._process.wait(PATIENCE_S)

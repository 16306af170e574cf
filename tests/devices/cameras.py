"""A fake of python-gphoto2: one camera with settings, that hands out files of counts."""

from __future__ import annotations

import numpy as np

from btfkit import counts


class GPhoto2Error(Exception):
    def __init__(self, code):
        super().__init__(f"[{code}] fault")
        self.code = code


class Widget:
    def __init__(self, value, choices):
        self.value, self.choices = value, choices

    def get_value(self):
        return self.value

    def set_value(self, value):
        self.value = value

    def get_choices(self):
        return iter(self.choices)


class Device:
    """A camera: light of 10 000 counts a second at ISO 100, black 200.

    Attributes:
        settings: value and choices by name. faults: code by call, raised once.
        stuck: settings that keep their value. suffix: of its files.
    """

    def __init__(self):
        self.settings = {
            "shutterspeed": ["1/30", ["bulb", "1/500", "1/30", "0.5", "2"]],
            "iso": ["100", ["Auto", "100", "400"]],
            "focusmode": ["Manual", ["Manual", "AF-S"]],
            "expprogram": ["M", ["M", "P"]],
        }
        self.faults, self.stuck, self.suffix = {}, set(), ".png"
        self.opened = self.deleted = 0

    def _meet(self, call):
        code = self.faults.pop(call, None)
        if code is not None:
            raise GPhoto2Error(code)

    def set_port_info(self, info):
        assert info == "port usb:001,005"

    def init(self):
        self._meet("init")
        self.opened += 1

    def exit(self):
        self.opened -= 1

    def list_config(self):
        return dict.fromkeys(self.settings, "")

    def get_single_config(self, name):
        return Widget(*self.settings[name])

    def set_single_config(self, name, widget):
        self._meet(name)
        if name not in self.stuck:
            self.settings[name][0] = widget.value

    def capture(self, kind):
        assert kind == "image"
        self._meet("capture")
        above, _, below = self.settings["shutterspeed"][0].partition("/")
        time = float(above) / float(below or 1)
        level = 200 + 1e4 * time * int(self.settings["iso"][0]) / 100
        self.picture = np.full((6, 8), min(level, 16383), np.uint16)
        return type("Path", (), {"folder": "/store/DCIM", "name": f"DSC_1{self.suffix}"})()

    def file_get(self, folder, name, kind):
        assert (folder, kind) == ("/store/DCIM", "normal")
        self._meet("file_get")
        data = counts.encode_png(self.picture)
        return type("File", (), {"get_data_and_size": lambda self: memoryview(data)})()

    def file_delete(self, folder, name):
        self.deleted += 1


class Library:
    """Stands for the module gphoto2."""

    GP_CAPTURE_IMAGE, GP_FILE_TYPE_NORMAL, GPhoto2Error = "image", "normal", GPhoto2Error

    def __init__(self, device=None, ports=("usb:001,005",)):
        self.device = device or Device()

        class Camera:
            def __new__(cls):
                return self.device

            @staticmethod
            def autodetect():
                return {f"Camera {port}": port for port in ports}

        class PortInfoList:
            def load(self):
                pass

            def lookup_path(self, path):
                return list(ports).index(path)

            def __getitem__(self, index):
                return f"port {ports[index]}"

        self.Camera, self.PortInfoList = Camera, PortInfoList

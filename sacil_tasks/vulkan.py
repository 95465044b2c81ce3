"""Which Vulkan devices can this machine render with, and if none, why in one sentence.

Asks the Vulkan loader through ctypes, in a child process: a broken driver then costs an answer,
not the program. Knows nothing of SAPIEN, so it also works where SAPIEN cannot start.
"""

import ctypes
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from sacil_tasks.errors import UsageError

MESA_NEEDED = (24, 3)
"""Older software Vulkan lacks VK_KHR_external_semaphore_fd, which SAPIEN asks for."""

INSTALL_HINT = (
    "`make setup` installs it on Debian 12/13 and Ubuntu 24.04 or newer; elsewhere install "
    "mesa-vulkan-drivers (Mesa >= 24.3) and libvulkan1."
)


@dataclass(frozen=True)
class VulkanDevice:
    """One physical device as the Vulkan loader lists it."""

    name: str
    """For example `llvmpipe (LLVM 19.1.7, 256 bits)`."""

    is_software: bool
    """Whether the processor does the drawing (Mesa's llvmpipe)."""

    driver: str
    """What the driver says of itself, for example `Mesa 25.0.7 (LLVM 19.1.7)`."""

    @property
    def mesa_version(self) -> tuple[int, int] | None:
        """Major and minor version of Mesa; None for other drivers."""
        found = re.search(r"Mesa (\d+)\.(\d+)", self.driver)
        return (int(found[1]), int(found[2])) if found else None

    def __str__(self) -> str:
        """Name and driver in one phrase."""
        return f"{self.name}, driver {self.driver or 'unnamed'}"


class VulkanError(Exception):
    """The loader is missing, refused, or died; the message says which."""


def find_problem(devices: Sequence[VulkanDevice]) -> str | None:
    """Say why none of `devices` can render for SAPIEN; None if one can."""
    if not devices:
        return f"no Vulkan device found. {INSTALL_HINT}"
    if any(not d.is_software or (d.mesa_version or MESA_NEEDED) >= MESA_NEEDED for d in devices):
        return None
    needed = ".".join(map(str, MESA_NEEDED))
    return f"{devices[0]} is too old, Mesa >= {needed} is needed. {INSTALL_HINT}"


def find_devices() -> tuple[VulkanDevice, ...]:
    """List the Vulkan devices of this machine, in a child process.

    Raises:
        VulkanError: there is no Vulkan loader, or it failed.
    """
    command = [sys.executable, "-m", __name__]
    child = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if child.returncode:
        lines = child.stderr.strip().splitlines() or [f"exit code {child.returncode}"]
        raise VulkanError(lines[-1])
    return tuple(VulkanDevice(**row) for row in json.loads(child.stdout))


def check_renderer() -> None:
    """Refuse to go on where nothing can render; takes under a second, starts no simulator.

    Raises:
        UsageError: what is missing and how to get it.
    """
    try:
        problem = find_problem(find_devices())
    except VulkanError as error:
        problem = f"Vulkan does not work here ({error}). {INSTALL_HINT}"
    if problem:
        raise UsageError(f"cannot render: {problem}")


def explain_render_failure(error: Exception) -> UsageError:
    """Turn what SAPIEN raised when it could not create a renderer into one clear sentence."""
    try:
        check_renderer()
    except UsageError as reason:
        return reason
    said = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return UsageError(
        f"cannot render: a Vulkan device is there, but SAPIEN said '{said}'. "
        "`python -m sacil_tasks.doctor` looks closer."
    )


class _ApplicationInfo(ctypes.Structure):
    """VkApplicationInfo; properties of drivers need version 1.2 of the interface."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.c_void_p),
        ("application", ctypes.c_char_p),
        ("application_version", ctypes.c_uint32),
        ("engine", ctypes.c_char_p),
        ("engine_version", ctypes.c_uint32),
        ("api_version", ctypes.c_uint32),
    )


class _InstanceInfo(ctypes.Structure):
    """VkInstanceCreateInfo without layers and extensions."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("application", ctypes.POINTER(_ApplicationInfo)),
        ("layers", ctypes.c_uint32),
        ("layer_names", ctypes.c_void_p),
        ("extensions", ctypes.c_uint32),
        ("extension_names", ctypes.c_void_p),
    )


class _DriverProperties(ctypes.Structure):
    """VkPhysicalDeviceDriverProperties."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.c_void_p),
        ("id", ctypes.c_uint32),
        ("name", ctypes.c_char * 256),
        ("info", ctypes.c_char * 256),
        ("conformance", ctypes.c_uint8 * 4),
    )


class _DeviceProperties(ctypes.Structure):
    """VkPhysicalDeviceProperties2; what follows the name is reserved and not read."""

    _fields_ = (
        ("type", ctypes.c_uint32),
        ("next", ctypes.POINTER(_DriverProperties)),
        ("numbers", ctypes.c_uint32 * 4),
        ("kind", ctypes.c_uint32),
        ("name", ctypes.c_char * 256),
        ("rest", ctypes.c_uint64 * 256),
    )


_INCOMPATIBLE_DRIVER = -9
_SOFTWARE = 4


def _create_instance(vulkan: ctypes.CDLL) -> ctypes.c_void_p | None:
    """Open Vulkan 1.2; None if the loader knows no driver at all."""
    application = _ApplicationInfo(api_version=1 << 22 | 2 << 12)
    info = _InstanceInfo(type=1, application=ctypes.pointer(application))
    instance = ctypes.c_void_p()
    code = vulkan.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance))
    if code == _INCOMPATIBLE_DRIVER:
        return None
    if code:
        raise VulkanError(f"vkCreateInstance failed with code {code}")
    return instance


def _ask_loader() -> Iterator[VulkanDevice]:
    """List devices in this process, through the C interface of libvulkan."""
    vulkan = ctypes.CDLL("libvulkan.so.1")
    instance = _create_instance(vulkan)
    if instance is None:
        return
    count = ctypes.c_uint32()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    handles = (ctypes.c_void_p * count.value)()
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
    for handle in handles:
        driver = _DriverProperties(type=1000196000)
        device = _DeviceProperties(type=1000059001, next=ctypes.pointer(driver))
        vulkan.vkGetPhysicalDeviceProperties2(ctypes.c_void_p(handle), ctypes.byref(device))
        name, info = device.name.decode(), driver.info.decode() or driver.name.decode()
        yield VulkanDevice(name, device.kind == _SOFTWARE, info)


if __name__ == "__main__":
    try:
        print(json.dumps([asdict(device) for device in _ask_loader()]))
    except (OSError, VulkanError) as failure:
        sys.exit(str(failure))

"""The renderer's verdict: what a machine without Vulkan, or with an old Mesa, is told."""

import pytest

from sacil_tasks import vulkan
from sacil_tasks.errors import UsageError
from sacil_tasks.vulkan import VulkanDevice, explain_render_failure, find_devices, find_problem

NEW = VulkanDevice("llvmpipe", is_software=True, driver="Mesa 25.0.7-2 (LLVM 19.1.7)")
OLD = VulkanDevice("llvmpipe", is_software=True, driver="Mesa 24.2.8-1ubuntu1 (LLVM 19.1.1)")
GPU = VulkanDevice("NVIDIA H200", is_software=False, driver="570.86.15")


@pytest.mark.parametrize("devices", [[NEW], [GPU], [OLD, GPU], [OLD, NEW]])
def test_one_good_device_is_enough(devices):
    assert find_problem(devices) is None


def test_an_old_mesa_is_named_with_the_version_it_should_have():
    assert "Mesa 24.2.8" in find_problem([OLD])
    assert "Mesa >= 24.3" in find_problem([OLD])


def test_no_device_says_what_to_install():
    assert "mesa-vulkan-drivers" in find_problem([])


def test_a_machine_without_vulkan_drivers_is_refused_in_one_sentence(monkeypatch, tmp_path):
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none.json"))
    assert find_devices() == ()
    with pytest.raises(UsageError, match="cannot render: no Vulkan device found"):
        vulkan.check_renderer()
    reason = explain_render_failure(RuntimeError("vk::createInstanceUnique"))
    assert "\n" not in str(reason)
    assert "no Vulkan device found" in str(reason)


def test_a_missing_loader_is_a_sentence_too(monkeypatch):
    def no_loader():
        raise vulkan.VulkanError("libvulkan.so.1: cannot open shared object file")

    monkeypatch.setattr(vulkan, "find_devices", no_loader)
    with pytest.raises(UsageError, match=r"libvulkan\.so\.1"):
        vulkan.check_renderer()


def test_this_machine_can_render():
    assert find_problem(find_devices()) is None

"""Exits with 0 where EGL can draw without a display; run in a process of its own, which a driver may end."""

import ctypes
import sys

DEVICE, OPENGL, NONE = 0x313F, 0x30A2, 0x3038  # EGL_PLATFORM_DEVICE_EXT, EGL_OPENGL_API, EGL_NONE


def draws() -> bool:
    """Whether a device has a display that takes a context of OpenGL; the library may be there without any."""
    pointer = ctypes.c_void_p
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = egl.eglCreateContext.restype = pointer
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    get_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query or not get_display:
        return False
    devices, count = (pointer * 16)(), ctypes.c_int(0)
    ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, pointer, pointer)(query)(16, devices, ctypes.byref(count))
    of_device = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(get_display)
    for device in devices[: count.value]:
        display = pointer(of_device(DEVICE, device, None))
        config, found = pointer(), ctypes.c_int(0)
        ready = display and egl.eglInitialize(display, None, None) and egl.eglBindAPI(OPENGL)
        wanted = (ctypes.c_int * 5)(0x3040, 8, 0x3033, 1, NONE)  # renderable by OpenGL, surfaces are buffers
        if ready and egl.eglChooseConfig(display, wanted, ctypes.byref(config), 1, ctypes.byref(found)) and found.value:
            context = egl.eglCreateContext(display, config, None, None)
            if context and egl.eglMakeCurrent(display, None, None, pointer(context)):
                return True
    return False


if __name__ == "__main__":
    try:
        sys.exit(0 if draws() else 1)
    except (OSError, AttributeError):
        sys.exit(1)

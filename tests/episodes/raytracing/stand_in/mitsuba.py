"""What the ray tracer's process asks Mitsuba for."""


def variant():
    return "llvm_ad_mono_polarized"

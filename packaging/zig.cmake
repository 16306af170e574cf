# Kernels for any Linux of glibc 2.28 or later (manylinux_2_28): PyPI's ziglang is a compiler that
# knows the symbols of every glibc. packaging/wheel.py names it by BTFKIT_ZIG.
set(CMAKE_CXX_COMPILER "$ENV{BTFKIT_ZIG}" c++ -target "$ENV{BTFKIT_ZIG_TARGET}")
set(CMAKE_AR "$ENV{BTFKIT_ZIG}")
set(CMAKE_CXX_ARCHIVE_CREATE "<CMAKE_AR> ar qc <TARGET> <OBJECTS>")
set(CMAKE_CXX_ARCHIVE_APPEND "<CMAKE_AR> ar q <TARGET> <OBJECTS>")
set(CMAKE_CXX_ARCHIVE_FINISH "")

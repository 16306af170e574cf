// How GCC is told to use all of AVX-512's width; Clang does so unasked, and would ignore every
// feature of a target that names this one.
#pragma once

#if defined(__clang__)
#define WIDE ""
#else
#define WIDE ",prefer-vector-width=512"
#endif

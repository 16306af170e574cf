// What the processor can do, and how compilers are told to use it.
//
// GCC is told to use all of AVX-512's width; Clang does so unasked, and would ignore every feature of
// a target that names that one. GCC's own question is answered by its run-time library, which some
// Clangs come without: there the processor is asked.
#pragma once

#if defined(__clang__)
#define WIDE ""
#else
#define WIDE ",prefer-vector-width=512"
#endif

#if defined(__x86_64__) && defined(__clang__)
#include <cpuid.h>

#include <cstring>

namespace processor {

// Bit n of register 0 to 3 (eax to edx) of a leaf.
inline bool bit(unsigned leaf, unsigned sub, int which, int n) {
    unsigned r[4] = {};
    return __get_cpuid_count(leaf, sub, r, r + 1, r + 2, r + 3) && (r[which] >> n & 1);
}

// Whether the system keeps the registers that are named by `bits` of XCR0.
inline bool kept(unsigned bits) {
    if (!bit(1, 0, 2, 27)) return false;
    unsigned low, high;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    return (low & bits) == bits;
}

// Source: Intel, Software Developer's Manual, volume 2, CPUID.
inline bool supports(const char* name) {
    struct Feature {
        const char* name;
        unsigned leaf, sub;
        int which, n;
    };
    static constexpr Feature features[] = {
        {"fma", 1, 0, 2, 12},       {"f16c", 1, 0, 2, 29},      {"avx2", 7, 0, 1, 5},
        {"avx512f", 7, 0, 1, 16},   {"avx512dq", 7, 0, 1, 17},  {"avx512bw", 7, 0, 1, 30},
        {"avx512vl", 7, 0, 1, 31},  {"avx512bf16", 7, 1, 0, 5},
    };
    const bool wide = std::strncmp(name, "avx512", 6) == 0;
    for (const Feature& f : features)
        if (!std::strcmp(f.name, name)) return kept(wide ? 0xe6 : 6) && bit(f.leaf, f.sub, f.which, f.n);
    return false;
}

}  // namespace processor

#define CPU_SUPPORTS(name) processor::supports(name)
#else
#define CPU_SUPPORTS(name) __builtin_cpu_supports(name)
#endif

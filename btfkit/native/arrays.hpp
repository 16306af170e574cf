// Arrays that Python hands over, and how they are refused.
#pragma once

#include <nanobind/ndarray.h>

#include <stdexcept>

template <class T>
using In = nanobind::ndarray<const T, nanobind::c_contig, nanobind::device::cpu>;
template <class T>
using Out = nanobind::ndarray<T, nanobind::c_contig, nanobind::device::cpu>;

inline void require(bool good, const char* what) {
    if (!good) throw std::invalid_argument(what);
}

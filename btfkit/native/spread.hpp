// Work on several threads.
#pragma once

#include <algorithm>
#include <cstdint>
#include <exception>
#include <functional>
#include <thread>
#include <vector>

// work(part, from, to) on `threads` equal runs of `size`, cut at multiples of `grain`.
inline void spread(int64_t size, int64_t grain, int threads,
                   const std::function<void(int, int64_t, int64_t)>& work) {
    const int64_t grains = (size + grain - 1) / grain;
    auto cut = [&](int part) { return std::min(size, grains * part / threads * grain); };
    std::vector<std::thread> others;
    std::exception_ptr failure;
    for (int part = 1; part < threads; ++part)
        if (cut(part) < cut(part + 1))
            others.emplace_back([&, part] { work(part, cut(part), cut(part + 1)); });
    try {
        if (cut(0) < cut(1)) work(0, cut(0), cut(1));
    } catch (...) {
        failure = std::current_exception();
    }
    for (auto& thread : others) thread.join();
    if (failure) std::rethrow_exception(failure);
}

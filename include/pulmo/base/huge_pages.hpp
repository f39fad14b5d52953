/// @file
/// Large pages for large arrays.
#pragma once

#include <cstddef>
#include <cstdint>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace pulmo {

/// Asks for pages of 2 MB behind an array that was not written to yet: what jumps about in it then misses the
/// machine's table of addresses less often. The system may refuse; nothing depends on it.
inline void prefer_huge_pages(void *array, std::size_t bytes)
{
#ifdef MADV_HUGEPAGE
  constexpr std::uintptr_t page = 1 << 21;
  const auto begin = reinterpret_cast<std::uintptr_t>(array), end = (begin + bytes) / page * page;
  const std::uintptr_t first = (begin + page - 1) / page * page;
  if (first < end) (void)madvise(reinterpret_cast<void *>(first), end - first, MADV_HUGEPAGE);
#else
  (void)array, (void)bytes;
#endif
}

} // namespace pulmo

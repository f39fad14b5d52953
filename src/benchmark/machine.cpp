// What this machine can do at best: floating-point operations with fused multiply-add in registers, and bytes to and
// from memory (STREAM's triad, and reading alone). Every rank does the same at once; the rates are sums over the ranks,
// the best of the repeats. Called by tools/benchmark.
//
//   mpiexec -n N pulmo_machine_benchmark [megabytes per array, default 128]
//
// Prints one JSON object, rates in 10^9 per second.
#include "pulmo/base/simd.hpp"

#include <mpi.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <functional>
#include <vector>

namespace {

using pulmo::Vector4;

constexpr int repeats = 10;

constexpr int lanes = 4; // of the vectors of integration.cpp

double sink = 0; // what is computed ends here, so that it is computed

/// Work of all ranks over the shortest time from a common start to the end of the slowest.
double best_rate(double work, const std::function<void()> &kernel)
{
  double best = 1e300;
  kernel();
  for (int i = 0; i < repeats; ++i) {
    MPI_Barrier(MPI_COMM_WORLD);
    double seconds = -MPI_Wtime();
    kernel();
    seconds += MPI_Wtime();
    MPI_Allreduce(MPI_IN_PLACE, &seconds, 1, MPI_DOUBLE, MPI_MAX, MPI_COMM_WORLD);
    best = std::min(best, seconds);
  }
  MPI_Allreduce(MPI_IN_PLACE, &work, 1, MPI_DOUBLE, MPI_SUM, MPI_COMM_WORLD);
  return 1e-9 * work / best;
}

/// Chains of multiply-adds, enough of them to hide the latency of one (two units of 4 to 5 cycles).
double multiply_adds()
{
  constexpr int chains = 12, steps = 2000000;
  return best_rate(2.0 * chains * steps * lanes, [] {
    Vector4 x[chains], a, b;
    for (int l = 0; l < lanes; ++l) {
      a[l] = 0.999999;
      b[l] = 1e-6 * l;
      for (int c = 0; c < chains; ++c) x[c][l] = c + l;
    }
    for (int i = 0; i < steps; ++i)
#pragma GCC unroll 12
      for (int c = 0; c < chains; ++c) x[c] = x[c] * a + b;
    for (int c = 0; c < chains; ++c) sink += x[c][0];
  });
}

/// Bytes of the triad as STREAM counts them: two arrays read, one written.
double triad(std::vector<double> &a, const std::vector<double> &b, const std::vector<double> &c)
{
  return best_rate(24.0 * static_cast<double>(a.size()), [&] {
    double *__restrict x = a.data();
    const double *__restrict y = b.data(), *__restrict z = c.data();
    for (std::size_t i = 0; i < a.size(); ++i) x[i] = y[i] + 3.0 * z[i];
    sink += x[a.size() / 2];
  });
}

double reading(const std::vector<double> &a)
{
  return best_rate(8.0 * static_cast<double>(a.size()), [&] {
    Vector4 sum[8] = {};
    const double *x = a.data();
    for (std::size_t i = 0; i + 32 <= a.size(); i += 32)
#pragma GCC unroll 8
      for (int k = 0; k < 8; ++k) sum[k] += *reinterpret_cast<const pulmo::Vector4InArray *>(x + i + 4 * k);
    for (const Vector4 &s : sum) sink += s[0];
  });
}

} // namespace

int main(int argc, char **argv)
{
  int ranks, rank;
  if (MPI_Init(&argc, &argv) != MPI_SUCCESS) return 1;
  MPI_Comm_size(MPI_COMM_WORLD, &ranks);
  MPI_Comm_rank(MPI_COMM_WORLD, &rank);
  const std::size_t n = 1000000 * (argc > 1 ? std::strtoul(argv[1], nullptr, 10) : 128) / sizeof(double);
  const double peak = multiply_adds();
  std::vector<double> a(n, 1.0), b(n, 2.0), c(n, 0.5);
  const double triad_rate = triad(a, b, c), read_rate = reading(a);
  if (rank == 0)
    std::printf("{\"ranks\": %d, \"gflops\": %.3f, \"triad_gb\": %.3f, \"read_gb\": %.3f, "
                "\"array_mb\": %.0f, \"check\": %.3g}\n",
                ranks, peak, triad_rate, read_rate, 8e-6 * static_cast<double>(n), sink);
  return MPI_Finalize() == MPI_SUCCESS ? 0 : 1;
}

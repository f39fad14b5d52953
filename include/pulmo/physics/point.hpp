/// @file
/// Between PETSc's pointwise callbacks and the physics: kernels see a `Point` and their own parameter
/// struct, never raw arrays.
///
/// A kernel is a static function `void k(const Point &, const Parameters &, PetscScalar out[])` that ADDS
/// its share to `out`. The adaptors below turn it into the callback that PetscDS and PetscWeakForm take:
///
///   residual terms:  f0[c], f1[3 * c + d]                    for the weak form  f0 . q + f1 : Grad q
///   jacobian terms:  g0[Nj * c + e], g1[(Nj * c + e) * 3 + d] (Grad of the trial field),
///                    g2[(Nj * c + e) * 3 + d] (Grad of the test field), g3[((Nj * c + e) * 3 + d) * 3 + l]
#pragma once

#include "pulmo/base/petsc.hpp"
#include "pulmo/physics/kinematics.hpp"

#include <array>
#include <cstdint>
#include <cstring>
#include <string_view>
#include <type_traits>
#include <vector>

/// What a kernel does not read of its point is then not made at all.
#define PULMO_ALWAYS_INLINE [[gnu::always_inline]] inline

namespace pulmo {

/// Order of the fields that pulmo's kernels know. Displacement is always there, pressure only with airflow.
enum FieldIndex : PetscInt { displacement = 0, pressure = 1 };

/// The parameters of a kernel that reads two blocks, e.g. its own and those of the tissue: Both<Mine, Porosity>. Each
/// of them may be two.
template <class A, class B>
struct Both {
  A own;
  B other;
};
template <class P>
constexpr bool is_both = false;
template <class A, class B>
constexpr bool is_both<Both<A, B>> = true;

/// The owners of the blocks that a kernel reads, its own first; null: none.
using Owners = std::array<const char *, 3>;
/// Those of a kernel with parameters @p P.
template <class P>
constexpr Owners owners_of()
{
  Owners all{};
  if constexpr (is_both<P>) {
    std::size_t n = 0;
    for (const char *owner : owners_of<decltype(P::own)>())
      if (owner) all[n++] = owner;
    for (const char *owner : owners_of<decltype(P::other)>())
      if (owner) all[n++] = owner; // too many are an error of the compiler's
  } else if constexpr (!std::is_empty_v<P>) {
    all[0] = P::owner;
  }
  return all;
}

/// The constants of PetscDS are a directory: [n, (tag, offset) x n, payload]. Each effect finds its own
/// block by the tag made from its name and needs to know of no other.
namespace constants {

/// 50-bit FNV-1a hash of an effect's name: exact in a double.
constexpr PetscScalar tag(std::string_view name)
{
  std::uint64_t h = 1469598103934665603ull;
  for (char c : name) h = (h ^ static_cast<unsigned char>(c)) * 1099511628211ull;
  return static_cast<PetscScalar>(h >> 14);
}

/// Where the block with a tag begins; 0: there is none.
inline PetscInt offset_of(PetscScalar wanted, const PetscScalar c[])
{
  const auto n = static_cast<PetscInt>(c[0]);
  for (PetscInt i = 0; i < n; ++i)
    if (c[1 + 2 * i] == wanted) return static_cast<PetscInt>(c[2 + 2 * i]);
  return 0;
}

/// The parameter block of type @p P (a struct of PetscScalars that names its owner in `P::owner`).
template <class P>
PULMO_ALWAYS_INLINE P get(const PetscScalar c[])
{
  P p{};
  if constexpr (is_both<P>) {
    p.own = get<decltype(p.own)>(c);
    p.other = get<decltype(p.other)>(c);
  } else if constexpr (!std::is_empty_v<P>) {
    static_assert(std::is_trivially_copyable_v<P> && sizeof(P) % sizeof(PetscScalar) == 0,
                  "parameters reach the kernels as plain scalars");
    const PetscInt offset = offset_of(tag(P::owner), c);
    if (offset > 0) std::memcpy(static_cast<void *>(&p), c + offset, sizeof(P));
  }
  return p;
}

/// Where an effect's quantities begin in what is remembered at a point of a cell, or of a facet: a block of its own in
/// the directory.
constexpr PetscScalar memory_tag(const char *owner, bool on_surface)
{
  return tag(owner) + (on_surface ? 0.25 : 0.5); // tags are whole
}

/// @p at a point's memory, moved on to the quantities of @p owner; nothing if it remembers none there.
template <class M>
M memory(const M &at, const char *owner, bool on_surface, const PetscScalar c[])
{
  const PetscScalar wanted = memory_tag(owner, on_surface);
  const PetscInt block = at.last ? offset_of(wanted, c) : 0;
  if (block == 0) return {};
  const auto offset = static_cast<PetscInt>(c[block]);
  return {at.last + offset, at.earlier ? at.earlier + offset : nullptr};
}

/// A function among the constants: its address, bit for bit.
template <class F>
PetscScalar to_scalar(F function)
{
  PetscScalar bits;
  static_assert(sizeof(function) == sizeof(bits));
  std::memcpy(&bits, &function, sizeof(bits));
  return bits;
}
template <class F>
F to_pointer(PetscScalar bits)
{
  F function;
  std::memcpy(&function, &bits, sizeof(bits));
  return function;
}

} // namespace constants

/// For kernels without parameters of their own.
struct NoParameters {};

/// How the stage at hand makes rates: u_t = slope u + what the states before it add. Backward Euler: slope = 1 / dt.
struct Stage {
  PetscReal dt;                              ///< from the last accepted state to the end of the stage, s
  PetscReal slope;                           ///< 1/s
  bool multistep = false;                    ///< more than one state before counts (TimeScheme)
  PetscReal last_weight, earlier_weight = 0; ///< of these states in a rate, 1/s

  Stage(PetscReal step, PetscReal a, bool several, PetscReal last = 0, PetscReal earlier = 0)
      : dt(step), slope(a), multistep(several), last_weight(last), earlier_weight(earlier)
  {}
  /// Backward Euler. Implicit: a step of that scheme is told by its size.
  Stage(PetscReal step) : dt(step), slope(1 / step), last_weight(-1 / step) {}
};

/// What the time step tells every kernel.
struct Step {
  static constexpr const char *owner = "step";
  PetscScalar dt = 1;             ///< size of the step, s
  PetscScalar slope = 1;          ///< d(rate)/d(state), 1/s
  PetscScalar multistep = 0;      ///< 1: rates hold more than one state before (Stage)
  PetscScalar last_weight = -1;   ///< of the state before in a rate, 1/s
  PetscScalar earlier_weight = 0; ///< of the one before that
  PetscScalar gas_pressure = 0;   ///< pressure held at the airway, kPa
  PetscScalar airway_flux = 0;    ///< outward flux prescribed at the airway (0 while a pressure is held), mm/s
  PetscScalar load = 1; ///< share of the dead loads that is there: less than 1 where the first step of a run was cut

  Step() = default;
  explicit Step(const Stage &stage, PetscScalar gas = 0, PetscScalar flux = 0)
      : dt(stage.dt), slope(stage.slope), multistep(stage.multistep ? 1 : 0), last_weight(stage.last_weight),
        earlier_weight(stage.earlier_weight), gas_pressure(gas), airway_flux(flux)
  {}
};

/// What an effect remembers at a point of a cell or a facet (Composition::remember), as its own kernels see it.
struct Memory {
  const PetscScalar *last = nullptr; ///< at the last accepted state; null at the start, and where nothing is remembered
  const PetscScalar *earlier = nullptr; ///< at the one before that, where the time scheme looks back so far
};

/// The memory of a whole cell or facet. PETSc's own integrator hands no memory over: there the points find theirs by
/// where they are.
struct PlaceMemory {
  static constexpr const char *owner = "place_memory"; ///< of its address among the constants
  Memory first;                                        ///< of the first point
  PetscInt width = 0;                                  ///< scalars of a point
  std::vector<PetscReal> x;                            ///< [point][3], mm

  Memory nearest(const PetscReal at[3]) const;
  /// The memory of the point at @p at of the place that the constants @p c name, or none.
  static Memory find(const PetscReal at[3], const PetscScalar c[]);
};

/// Whether the effect with parameters @p P is given what it remembers at the start (Composition::begin_with).
template <class P, class = void>
constexpr bool given_at_start = false;
template <class P>
constexpr bool given_at_start<P, std::void_t<decltype(P::given_at_start)>> = P::given_at_start;

/// A quadrature point as a kernel sees it.
struct Point {
  const PointState &state;   ///< F, J, Grad u_t
  const PetscScalar *u;      ///< displacement, mm
  PetscScalar p = 0;         ///< alveolar pressure, kPa (airflow only)
  const PetscScalar *grad_p; ///< Grad p, kPa/mm (null without airflow)
  PetscReal t;               ///< time, s
  PetscReal shift;           ///< d(u_t)/du in Jacobians, 1/s
  const PetscReal *x;        ///< material coordinates, mm
  const PetscReal *normal;   ///< outward unit normal (null in the volume)
  Step step;
  const PetscScalar *u_t = nullptr;      ///< velocity, mm/s
  PetscScalar p_t = 0;                   ///< kPa/s (airflow only)
  const PetscScalar *grad_p_t = nullptr; ///< Grad p_t, kPa/(mm s) (null without airflow)

  Memory memory{};                        ///< of the kernel's own effect
  const PetscScalar *constants = nullptr; ///< what all effects handed over (for LawFunctions)
  Memory of_all{};                        ///< of all effects
  bool start = false;                     ///< nothing was accepted yet: of_all holds what was given at the start alone

  /// The share of the past in the rate of quantity @p i that the effect remembers: dy/dt = step.slope y + past(i).
  PetscScalar past(int i) const
  {
    return (memory.last ? step.last_weight * memory.last[i] : 0) +
           (memory.earlier ? step.earlier_weight * memory.earlier[i] : 0);
  }
  /// This point as the kernels of another effect see it, whose parameters are @p P, among @p c.
  template <class P>
  Point as_seen_by(const PetscScalar c[]) const
  {
    Point other = *this;
    other.memory = {};
    if (!start || given_at_start<P>) other.memory = constants::memory(of_all, P::owner, normal != nullptr, c);
    return other;
  }
  /// Pressure of the gas in the pores: the local field, or the uniform pressure without airflow, kPa.
  PetscScalar gas_pressure() const { return grad_p ? p : step.gas_pressure; }
};

/// NfAux that says: the auxiliary array is a PointState made by pulmo's integrator, its gradients those of the rates,
/// its rates the Memory of all effects or null.
constexpr PetscInt precomputed_state = -1;

/// NfAux that says: all points of a cell or facet at once, of which pulmo's integrator hands over the first. The
/// auxiliary array is a PointBatch; all other arrays go on from point to point. Parameters are then looked up once.
constexpr PetscInt all_points = -2;

/// The points of a call for all of them.
struct PointBatch {
  PetscInt n;               ///< how many
  PetscInt components;      ///< of all fields at a point
  PetscInt stride;          ///< of the output, from point to point
  const PointState *states; ///< [point]
  const Memory *memory;     ///< [point], of all effects; null: nothing is remembered here
};

template <class P>
using Kernel = void (*)(const Point &, const P &, PetscScalar[]);

namespace detail {

/// The arguments that all four kinds of callback begin with.
#define PULMO_POINT_ARGUMENTS                                                                                          \
  PetscInt, PetscInt Nf, PetscInt NfAux, const PetscInt uOff[], const PetscInt uOff_x[], const PetscScalar u[],        \
      const PetscScalar u_t[], const PetscScalar u_x[], const PetscInt[], const PetscInt aOff_x[],                     \
      const PetscScalar a[], const PetscScalar a_t[], const PetscScalar a_x[], PetscReal t

/// The point of a callback. Its kinematic state is handed in by pulmo's integrator, or made here in @p storage
/// (stock PetscFE, where auxiliary fields of the same discretisation carry u_t and p_t).
template <class P>
PULMO_ALWAYS_INLINE Point make_point(PointState &storage, PetscInt Nf, PetscInt NfAux, const PetscInt uOff[],
                                     const PetscInt uOff_x[], const PetscScalar u[], const PetscScalar u_t[],
                                     const PetscScalar u_x[], const PetscInt aOff_x[], const PetscScalar a[],
                                     const PetscScalar a_t[], const PetscScalar a_x[], PetscReal t, PetscReal shift,
                                     const PetscReal x[], const PetscReal normal[], const Step &step,
                                     const PetscScalar c[])
{
  const bool made = NfAux == precomputed_state, gas = Nf > pressure;
  if (!made) make_point_state(u_x + uOff_x[displacement], NfAux > 0 ? a_x + aOff_x[displacement] : nullptr, storage);
  Memory memory, all;
  if constexpr (!std::is_empty_v<P>) {
    if (!made)
      all = PlaceMemory::find(x, c);
    else if (a_t)
      all = *reinterpret_cast<const Memory *>(a_t);
    if (all.last) memory = constants::memory(all, owners_of<P>()[0], normal != nullptr, c);
  }
  return {made ? *reinterpret_cast<const PointState *>(a) : storage,
          u + uOff[displacement],
          gas ? u[uOff[pressure]] : 0,
          gas ? u_x + uOff_x[pressure] : nullptr,
          t,
          shift,
          x,
          normal,
          step,
          u_t ? u_t + uOff[displacement] : nullptr,
          gas && u_t ? u_t[uOff[pressure]] : 0,
          gas && a_x && (made || NfAux > pressure) ? a_x + aOff_x[pressure] : nullptr,
          memory,
          c,
          all};
}

/// Calls kernel @p K at the point of a callback, or at all points of a cell or facet.
template <class P, Kernel<P> K>
PULMO_ALWAYS_INLINE void call_kernel(PetscInt Nf, PetscInt NfAux, const PetscInt uOff[], const PetscInt uOff_x[],
                                     const PetscScalar u[], const PetscScalar u_t[], const PetscScalar u_x[],
                                     const PetscInt aOff_x[], const PetscScalar a[], const PetscScalar a_t[],
                                     const PetscScalar a_x[], PetscReal t, PetscReal shift, const PetscReal x[],
                                     const PetscReal normal[], const PetscScalar c[], PetscScalar out[])
{
  const P parameters = constants::get<P>(c);
  const Step step = constants::get<Step>(c);
  PointState storage;
  if (NfAux != all_points) {
    K(make_point<P>(storage, Nf, NfAux, uOff, uOff_x, u, u_t, u_x, aOff_x, a, a_t, a_x, t, shift, x, normal, step, c),
      parameters, out);
    return;
  }
  const PointBatch &batch = *reinterpret_cast<const PointBatch *>(a);
  for (PetscInt q = 0; q < batch.n; ++q) {
    const PetscInt i = q * batch.components, i_x = 3 * i;
    K(make_point<P>(storage, Nf, precomputed_state, uOff, uOff_x, u + i, u_t + i, u_x + i_x, aOff_x,
                    reinterpret_cast<const PetscScalar *>(&batch.states[q]),
                    batch.memory ? reinterpret_cast<const PetscScalar *>(&batch.memory[q]) : nullptr, a_x + i_x, t,
                    shift, x + 3 * q, normal ? normal + 3 * q : nullptr, step, c),
      parameters, out + q * batch.stride);
  }
}

template <class P, Kernel<P> K>
void volume_residual(PULMO_POINT_ARGUMENTS, const PetscReal x[], PetscInt, const PetscScalar c[], PetscScalar f[])
{
  call_kernel<P, K>(Nf, NfAux, uOff, uOff_x, u, u_t, u_x, aOff_x, a, a_t, a_x, t, 0, x, nullptr, c, f);
}

template <class P, Kernel<P> K>
void volume_jacobian(PULMO_POINT_ARGUMENTS, PetscReal shift, const PetscReal x[], PetscInt, const PetscScalar c[],
                     PetscScalar g[])
{
  call_kernel<P, K>(Nf, NfAux, uOff, uOff_x, u, u_t, u_x, aOff_x, a, a_t, a_x, t, shift, x, nullptr, c, g);
}

template <class P, Kernel<P> K>
void surface_residual(PULMO_POINT_ARGUMENTS, const PetscReal x[], const PetscReal n[], PetscInt, const PetscScalar c[],
                      PetscScalar f[])
{
  call_kernel<P, K>(Nf, NfAux, uOff, uOff_x, u, u_t, u_x, aOff_x, a, a_t, a_x, t, 0, x, n, c, f);
}

template <class P, Kernel<P> K>
void surface_jacobian(PULMO_POINT_ARGUMENTS, PetscReal shift, const PetscReal x[], const PetscReal n[], PetscInt,
                      const PetscScalar c[], PetscScalar g[])
{
  call_kernel<P, K>(Nf, NfAux, uOff, uOff_x, u, u_t, u_x, aOff_x, a, a_t, a_x, t, shift, x, n, c, g);
}

} // namespace detail

#undef PULMO_POINT_ARGUMENTS

/// A callback and the owners of the parameters that it reads (null: none). One of a residual or Jacobian term is made
/// by the adaptors below: pulmo's integrator calls it for all_points.
template <class F>
struct Callback {
  F function = nullptr;
  Owners owners{};
};

// The callback of a kernel: residual terms (f0, f1) and Jacobian terms (g0 ... g3) of the volume and of surfaces.
template <class P, Kernel<P> K>
constexpr Callback<PetscPointFunc> volume_residual{detail::volume_residual<P, K>, owners_of<P>()};
template <class P, Kernel<P> K>
constexpr Callback<PetscPointJac> volume_jacobian{detail::volume_jacobian<P, K>, owners_of<P>()};
template <class P, Kernel<P> K>
constexpr Callback<PetscBdPointFunc> surface_residual{detail::surface_residual<P, K>, owners_of<P>()};
template <class P, Kernel<P> K>
constexpr Callback<PetscBdPointJac> surface_jacobian{detail::surface_jacobian<P, K>, owners_of<P>()};

/// A share of the energy balance of a step, from the state at its end and the one at its start: kPa per reference
/// volume, kPa mm per reference area. Rates are those of @p now.
template <class P>
using EnergyKernel = PetscScalar (*)(const Point &now, const Point &before, const P &);

/// The same as the energy audit calls it.
using EnergyDensity = PetscScalar (*)(const Point &now, const Point &before, const PetscScalar constants[]);

/// Computes what an effect remembers from the state at a point: Composition::remember().
template <class P>
using MemoryKernel = void (*)(const Point &now, const P &, PetscScalar value[]);
using MemoryFunction = void (*)(const Point &now, const PetscScalar constants[], PetscScalar value[]);

/// How what an effect says at a point follows from what it remembers there (Composition::by_past): adds to by_past[i]
/// the derivative of  sum_j weights[j] value[j] + f1 : gradient  by Point::past(i). value: what it remembers next; f1:
/// of its own terms of the displacement.
template <class P>
using PastKernel = void (*)(const Point &now, const P &, const PetscScalar weights[], const PetscScalar gradient[9],
                            PetscScalar by_past[]);
using PastFunction = void (*)(const Point &now, const PetscScalar constants[], const PetscScalar weights[],
                              const PetscScalar gradient[9], PetscScalar by_past[]);

/// How value follows from the state, weighted alike: adds to by_gradient the derivative by Grad u, and to by_pressure
/// that by the pressure of the gas in the pores. It follows from nothing else of the state.
template <class P>
using StateKernel = void (*)(const Point &now, const P &, const PetscScalar weights[], PetscScalar by_gradient[9],
                             PetscScalar &by_pressure);
using StateFunction = void (*)(const Point &now, const PetscScalar constants[], const PetscScalar weights[],
                               PetscScalar by_gradient[9], PetscScalar &by_pressure);

namespace detail {

/// @p point with its memory as the owner of @p P sees it.
template <class P>
Point own_memory(Point point, const PetscScalar c[])
{
  point.of_all = point.memory;
  if (point.start)
    point.memory = {};
  else if constexpr (!std::is_empty_v<P>)
    if (point.memory.last)
      point.memory = constants::memory(point.memory, owners_of<P>()[0], point.normal != nullptr, c);
  point.constants = c;
  return point;
}

template <class P, EnergyKernel<P> K>
PetscScalar energy_density(const Point &now, const Point &before, const PetscScalar c[])
{
  return K(own_memory<P>(now, c), own_memory<P>(before, c), constants::get<P>(c));
}

template <class P, MemoryKernel<P> K>
void remembered(const Point &now, const PetscScalar c[], PetscScalar value[])
{
  K(own_memory<P>(now, c), constants::get<P>(c), value);
}

template <class P, PastKernel<P> K>
void by_past(const Point &now, const PetscScalar c[], const PetscScalar weights[], const PetscScalar gradient[9],
             PetscScalar by[])
{
  K(own_memory<P>(now, c), constants::get<P>(c), weights, gradient, by);
}

template <class P, StateKernel<P> K>
void by_state(const Point &now, const PetscScalar c[], const PetscScalar weights[], PetscScalar by_gradient[9],
              PetscScalar &by_pressure)
{
  K(own_memory<P>(now, c), constants::get<P>(c), weights, by_gradient, by_pressure);
}

} // namespace detail

/// Callback of an energy kernel.
template <class P, EnergyKernel<P> K>
constexpr Callback<EnergyDensity> energy_density{detail::energy_density<P, K>, owners_of<P>()};

/// Callback of a memory kernel.
template <class P, MemoryKernel<P> K>
constexpr Callback<MemoryFunction> remembered{detail::remembered<P, K>, owners_of<P>()};

/// Callbacks of its derivatives.
template <class P, PastKernel<P> K>
constexpr Callback<PastFunction> by_past{detail::by_past<P, K>, owners_of<P>()};
template <class P, StateKernel<P> K>
constexpr Callback<StateFunction> by_state{detail::by_state<P, K>, owners_of<P>()};

} // namespace pulmo

/// @file
/// Vectors of doubles that the compiler keeps in as many registers as the machine has them wide.
#pragma once

namespace pulmo {

/// Two doubles: a scalar field at a node, then its rate.
typedef double Vector2 __attribute__((vector_size(16)));

/// Four doubles: the components of a node, or four entries of a row.
typedef double Vector4 __attribute__((vector_size(32)));
/// Four that lie in an array, at any address of a double. A template that deduces its type forgets that.
typedef double Vector4InArray __attribute__((vector_size(32), aligned(8), may_alias));

/// Nodes of the largest element whose components are gathered into vectors.
constexpr int max_nodes = 32;

/// Eight: the components of a node, then their rates.
typedef double Vector8 __attribute__((vector_size(64)));
typedef double Vector8InArray __attribute__((vector_size(64), aligned(8), may_alias));

} // namespace pulmo

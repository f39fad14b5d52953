/// @file
/// A number that a user gives, or an expression of x, y, z (mm) and t (s) in its place.
#pragma once

#include <petscsys.h>

#include <memory>
#include <string>

namespace pulmo {

/// Copies share what they were made of.
class Expression {
public:
  Expression(PetscReal number = 0) : number_(number) {}

  /// Reads @p text. @p fault: empty, or what is wrong, and @p column, counted from 1.
  static Expression read(const std::string &text, std::string &fault, std::size_t &column);

  /// Whether it is a number, wherever and whenever.
  bool constant() const { return !formula_; }
  bool of_place() const;
  /// As given.
  std::string text() const;
  /// At place @p x (mm) and time @p t (s); not finite where it has no value.
  PetscReal at(PetscReal t, const PetscReal x[3]) const { return formula_ ? evaluate(t, x) : number_; }

private:
  struct Formula;
  PetscReal evaluate(PetscReal t, const PetscReal x[3]) const;

  PetscReal number_;
  std::shared_ptr<Formula> formula_; ///< null: a number
};

} // namespace pulmo

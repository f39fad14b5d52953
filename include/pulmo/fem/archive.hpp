/// @file
/// What a run must remember to go on later, written to or read from an HDF5 file.
#pragma once

#include "pulmo/fem/model.hpp"
#include "pulmo/mesh/cell_order.hpp"
#include "pulmo/mesh/node_order.hpp"

#include <cmath>
#include <cstdint>
#include <map>
#include <optional>

namespace pulmo {

/// Visits numbers one after the other, to write or to read them.
class TableCells {
public:
  explicit TableCells(bool reading, std::vector<double> &values) : reading_(reading), values_(values) {}

  template <class... T>
  void operator()(T &...numbers)
  {
    (visit(numbers), ...);
  }
  /// Whether as many numbers were read as there are.
  bool whole() const { return !reading_ || next_ == values_.size(); }

private:
  template <class T>
  void visit(T &number)
  {
    if (!reading_)
      values_.push_back(static_cast<double>(number));
    else if (next_++ < values_.size())
      number = static_cast<T>(values_[next_ - 1]);
  }
  void visit(std::optional<double> &number) // none is NaN
  {
    double value = number.value_or(std::nan(""));
    visit(value);
    if (reading_) number = std::isnan(value) ? std::optional<double>() : value;
  }

  bool reading_;
  std::vector<double> &values_;
  std::size_t next_ = 0;
};

/// Every class with a memory has one function persist(Archive &) that names what it remembers; it serves for writing
/// and for reading, so that the two cannot differ. Rank 0 has the file, all ranks the same numbers. All functions are
/// collective; a read that fails is a user error that names the file.
class Archive {
public:
  /// An empty archive to write to.
  static PetscErrorCode create(const Model &model, const NodeOrder &order, std::unique_ptr<Archive> &archive);
  /// The archive in @p file, which @p option named. Errors of a file that is none, or of another format, are user
  /// errors.
  static PetscErrorCode open(const Model &model, const NodeOrder &order, const std::string &option,
                             const std::string &file, std::unique_ptr<Archive> &archive);
  ~Archive();
  Archive(const Archive &) = delete;
  Archive &operator=(const Archive &) = delete;

  bool reading() const { return reading_; }
  /// Ends writing. @p image: the file as it is to be on disk (rank 0).
  PetscErrorCode finish(std::vector<char> &image);

  /// A number or a flag.
  template <class T>
  PetscErrorCode value(const std::string &name, T &number)
  {
    double as_double = reading_ ? 0 : static_cast<double>(number);

    PetscFunctionBeginUser;
    PetscCall(scalar(name, as_double));
    if (reading_) number = static_cast<T>(as_double);
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  PetscErrorCode text(const std::string &name, std::string &text);
  /// Rows of numbers; @p visit(row, cells) hands the numbers of a row to the cells. @p empty: a row to read into.
  template <class Row, class Visit>
  PetscErrorCode table(const std::string &name, std::vector<Row> &rows, const Row &empty, Visit visit)
  {
    std::vector<double> values;
    std::size_t n = rows.size();
    TableCells cells(reading_, values);

    PetscFunctionBeginUser;
    if (reading_) {
      PetscCall(numbers(name, n, values));
      rows.assign(n, empty);
    }
    for (Row &row : rows) visit(row, cells);
    if (!reading_) PetscCall(numbers(name, n, values));
    PetscCall(check(cells.whole(), name));
    PetscFunctionReturn(PETSC_SUCCESS);
  }
  /// A local vector with its constrained values, field by field.
  PetscErrorCode local(const std::string &name, Vec x);
  /// @p width numbers for each cell of this rank, [cell][number].
  PetscErrorCode cells(const std::string &name, std::size_t width, std::vector<double> &values);
  /// The same for @p facets of this rank, those of surface @p surface.
  PetscErrorCode facets(const std::string &name, const std::string &surface, const std::vector<PetscInt> &facets,
                        std::size_t width, std::vector<double> &values);
  /// A global vector; what is constrained is not in it.
  PetscErrorCode global(const std::string &name, Vec X);
  /// User error unless @p good (the same on all ranks): the file does not hold @p name as this program needs it.
  PetscErrorCode check(bool good, const std::string &name) const;

private:
  Archive(const Model &model, const NodeOrder &order, bool reading);
  PetscErrorCode scalar(const std::string &name, double &number);
  /// Rows of @p width numbers that rank 0 alone has, and reads.
  PetscErrorCode rows_on_root(const std::string &name, std::size_t width, std::vector<double> &values);
  /// Rows that travel in @p order.
  PetscErrorCode ordered(const std::string &name, const CellOrder &order, std::size_t width,
                         std::vector<double> &values);
  /// @p n rows, equally long.
  PetscErrorCode numbers(const std::string &name, std::size_t &n, std::vector<double> &values);
  /// The same as check(), but rank 0 alone knows.
  PetscErrorCode check_root(bool good, const std::string &name) const;

  const Model &model_;
  const NodeOrder &order_;
  CellOrder cell_order_;                          ///< made when it is needed
  std::map<std::string, CellOrder> facet_orders_; ///< [surface]
  MPI_Comm comm_;
  bool root_, reading_, good_ = true;
  std::string option_, path_; ///< of a file that is read
  std::int64_t file_ = -1;    ///< HDF5's handle, on rank 0
  std::map<std::string, double> scalars_;
};

} // namespace pulmo

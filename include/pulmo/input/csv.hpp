/// @file
/// Tables that people write: comma-separated, a row of names first.
#pragma once

#include "pulmo/input/options.hpp"

#include <map>
#include <optional>
#include <string>
#include <vector>

namespace pulmo {

/// A table of text with named columns. Blanks around a cell and quotes around it do not count; rows without anything
/// and lines that begin with # neither.
class Csv {
public:
  /// Reads @p file, which @p option named; only the columns @p known may be there. Errors are user errors that name the
  /// file and the line. Collective.
  static PetscErrorCode read(MPI_Comm comm, const std::string &option, const std::string &file,
                             const std::vector<std::string> &known, Csv &table);
  /// The same of @p text; @p file names it in errors.
  static PetscErrorCode parse(MPI_Comm comm, const std::string &file, std::string text,
                              const std::vector<std::string> &known, Csv &table);

  std::size_t rows() const { return rows_.size(); }
  /// A cell; empty where the column is not there.
  const std::string &cell(std::size_t row, const std::string &column) const;
  /// FILE:LINE of a row.
  std::string where(std::size_t row) const { return file_ + ":" + std::to_string(lines_[row]); }
  /// The number in a cell; none where it is empty. User error where it is no number, or outside @p range.
  PetscErrorCode number(std::size_t row, const std::string &column, Range range, std::optional<PetscReal> &value) const;
  /// Of all cells: two tables that say the same have the same.
  std::string hash() const;

private:
  MPI_Comm comm_ = MPI_COMM_NULL;
  std::string file_;
  std::map<std::string, std::size_t> columns_;
  std::vector<std::vector<std::string>> rows_;
  std::vector<int> lines_;
};

} // namespace pulmo

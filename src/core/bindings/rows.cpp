// Rows of a database → columns, each row checked against its checksum: tens of thousands of rows
// are read when a map is opened. Twin: engram.maps.rows.verified.
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <cstring>
#include <string>
#include <unordered_map>

#include "bindings/arrays.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

// CRC-32 as zlib has it, eight bytes at a time.
class Crc32 {
public:
  Crc32() {
    for (uint32_t byte = 0; byte < 256; ++byte) {
      uint32_t value = byte;
      for (int bit = 0; bit < 8; ++bit)
        value = value & 1 ? 0xEDB88320u ^ (value >> 1) : value >> 1;
      table_[0][byte] = value;
    }
    for (int k = 1; k < 8; ++k)
      for (int byte = 0; byte < 256; ++byte) {
        const uint32_t before = table_[k - 1][byte];
        table_[k][byte] = (before >> 8) ^ table_[0][before & 255];
      }
  }

  uint32_t of(const uint8_t *data, size_t count) const {
    uint32_t crc = ~0u;
    for (; count >= 8; count -= 8, data += 8) {
      uint64_t mixed = 0;
      for (int k = 0; k < 8; ++k) // a load on little-endian machines
        mixed |= static_cast<uint64_t>(data[k]) << (8 * k);
      mixed ^= crc;
      crc = 0;
      for (int k = 0; k < 8; ++k)
        crc ^= table_[7 - k][(mixed >> (8 * k)) & 255];
    }
    for (; count > 0; --count, ++data)
      crc = (crc >> 8) ^ table_[0][(crc ^ *data) & 255];
    return ~crc;
  }

private:
  std::array<std::array<uint32_t, 256>, 8> table_;
};

// A MessagePack array in the making, in the shortest forms.
class Packed {
public:
  void begin(size_t count) {
    bytes_.clear();
    if (count < 16)
      bytes_.push_back(static_cast<uint8_t>(0x90 | count));
    else
      head(0xdc, count, 2);
  }

  void add_int(int64_t value) {
    const auto bits = static_cast<uint64_t>(value);
    if (value >= 0) {
      if (value < 128)
        bytes_.push_back(static_cast<uint8_t>(value));
      else
        head_of_size(0xcc, bits, bits < 256 ? 0 : bits < 65536 ? 1 : bits < (1ull << 32) ? 2 : 3);
    } else if (value >= -32) {
      bytes_.push_back(static_cast<uint8_t>(value));
    } else {
      head_of_size(0xd0, bits,
                   value >= -128 ? 0 : value >= -32768 ? 1 : value >= -(1ll << 31) ? 2 : 3);
    }
  }

  void add_double(double value) {
    uint64_t bits;
    std::memcpy(&bits, &value, 8);
    head(0xcb, bits, 8);
  }

  void add_text(const char *text, size_t count) {
    if (count < 32)
      bytes_.push_back(static_cast<uint8_t>(0xa0 | count));
    else
      head_of_size(0xd9, count, count < 256 ? 0 : count < 65536 ? 1 : 2);
    append(text, count);
  }

  void add_bytes(const char *data, size_t count) {
    head_of_size(0xc4, count, count < 256 ? 0 : count < 65536 ? 1 : 2);
    append(data, count);
  }

  const std::vector<uint8_t> &bytes() const { return bytes_; }

private:
  void append(const char *data, size_t count) {
    bytes_.insert(bytes_.end(), data, data + count);
  }

  // MessagePack's tags of one type follow each other by the logarithm of the size.
  void head_of_size(uint8_t first, uint64_t value, int log2_size) {
    head(static_cast<uint8_t>(first + log2_size), value, 1 << log2_size);
  }

  void head(uint8_t tag, uint64_t value, int size) {
    bytes_.push_back(tag);
    for (int shift = 8 * (size - 1); shift >= 0; shift -= 8)
      bytes_.push_back(static_cast<uint8_t>(value >> shift));
  }

  std::vector<uint8_t> bytes_;
};

// A column: of integers, of numbers, of texts (few different ones), or of so many bytes each.
struct Column {
  char kind = 'i';
  size_t size = 0;
  std::vector<int64_t> ints;
  std::vector<double> doubles;
  std::vector<uint8_t> bytes;
  std::vector<int32_t> codes;
  std::vector<std::string> texts;
  std::unordered_map<std::string, int32_t> code_of;

  void reserve(size_t rows) {
    ints.reserve(kind == 'i' ? rows : 0);
    doubles.reserve(kind == 'f' ? rows : 0);
    codes.reserve(kind == 's' ? rows : 0);
    bytes.reserve(kind == 'b' ? rows * size : 0);
  }

  // Adds the value to the column and to the packed row. False if it is of another type.
  bool add(PyObject *value, Packed &packed, bool &fits) {
    switch (kind) {
    case 'i':
      return add_int(value, packed);
    case 'f':
      if (!PyFloat_CheckExact(value))
        return false;
      doubles.push_back(PyFloat_AsDouble(value));
      packed.add_double(doubles.back());
      return true;
    case 's':
      return add_text(value, packed);
    default:
      return add_bytes(value, packed, fits);
    }
  }

  nb::object to_python(size_t rows) {
    switch (kind) {
    case 'i':
      return nb::cast(engram::to_numpy(std::move(ints), {rows}));
    case 'f':
      return nb::cast(engram::to_numpy(std::move(doubles), {rows}));
    case 's':
      return nb::make_tuple(engram::to_numpy(std::move(codes), {rows}), texts);
    default:
      return nb::cast(engram::to_numpy(std::move(bytes), {rows, size}));
    }
  }

private:
  bool add_int(PyObject *value, Packed &packed) {
    if (!PyLong_CheckExact(value))
      return false;
    int overflow = 0;
    const long long number = PyLong_AsLongLongAndOverflow(value, &overflow);
    if (overflow != 0)
      return false;
    ints.push_back(number);
    packed.add_int(number);
    return true;
  }

  bool add_text(PyObject *value, Packed &packed) {
    if (!PyUnicode_CheckExact(value))
      return false;
    Py_ssize_t count = 0;
    const char *text = PyUnicode_AsUTF8AndSize(value, &count);
    if (text == nullptr) {
      PyErr_Clear(); // no valid Unicode: no row of ours
      return false;
    }
    packed.add_text(text, static_cast<size_t>(count));
    const auto [found, fresh] = code_of.try_emplace(std::string(text, static_cast<size_t>(count)),
                                                    static_cast<int32_t>(texts.size()));
    if (fresh)
      texts.push_back(found->first);
    codes.push_back(found->second);
    return true;
  }

  bool add_bytes(PyObject *value, Packed &packed, bool &fits) {
    char *data = nullptr;
    Py_ssize_t count = 0;
    if (!PyBytes_CheckExact(value) || PyBytes_AsStringAndSize(value, &data, &count) != 0)
      return false;
    packed.add_bytes(data, static_cast<size_t>(count));
    fits = fits && static_cast<size_t>(count) == size;
    if (fits)
      bytes.insert(bytes.end(), data, data + count);
    return true;
  }
};

std::vector<Column> columns_of(const std::vector<std::string> &kinds) {
  std::vector<Column> columns(kinds.size());
  for (size_t i = 0; i < kinds.size(); ++i) {
    const std::string &kind = kinds[i];
    if (kind.empty() || std::string("ifsb").find(kind[0]) == std::string::npos)
      throw nb::value_error("a column is of kind i, f, s or b with a number of bytes");
    columns[i].kind = kind[0];
    columns[i].size = kind.size() > 1 ? std::stoul(kind.substr(1)) : 0;
  }
  return columns;
}

// (columns, −1, −1); or (None, row, −1) for a row that is not as it was written, and
// (None, row, column) for bytes of another number.
nb::object verified_columns(const nb::list &rows, const std::vector<std::string> &kinds) {
  static const Crc32 crc;
  std::vector<Column> columns = columns_of(kinds);
  for (Column &column : columns)
    column.reserve(rows.size());
  Packed packed;
  const size_t count = rows.size(), width = columns.size();
  for (size_t at = 0; at < count; ++at) {
    PyObject *row = PyList_GetItem(rows.ptr(), static_cast<Py_ssize_t>(at)); // borrowed
    const auto refused = [&](int64_t column) {
      return nb::make_tuple(nb::none(), at, column);
    };
    if (!PyTuple_CheckExact(row) || static_cast<size_t>(PyTuple_Size(row)) != width + 1)
      return refused(-1);
    packed.begin(width);
    int64_t misfit = -1;
    for (size_t i = 0; i < width; ++i) {
      bool fits = true;
      if (!columns[i].add(PyTuple_GetItem(row, static_cast<Py_ssize_t>(i)), packed, fits))
        return refused(-1);
      if (!fits && misfit < 0)
        misfit = static_cast<int64_t>(i);
    }
    PyObject *checksum = PyTuple_GetItem(row, static_cast<Py_ssize_t>(width));
    int overflow = 0;
    if (!PyLong_CheckExact(checksum) ||
        PyLong_AsLongLongAndOverflow(checksum, &overflow) !=
            static_cast<long long>(crc.of(packed.bytes().data(), packed.bytes().size())) ||
        overflow != 0)
      return refused(-1);
    if (misfit >= 0)
      return refused(misfit);
  }
  nb::list found;
  for (Column &column : columns)
    found.append(column.to_python(count));
  return nb::make_tuple(found, -1, -1);
}

} // namespace

void bind_rows(nb::module_ &module) {
  module.def("verified_columns", &verified_columns, "rows"_a, "kinds"_a,
             "Columns of rows that end in a checksum: i (N,) int64, f (N,) float64, s ((N,) int32 "
             "index, texts), bSIZE (N, SIZE) uint8. (columns, -1, -1); (None, row, -1) for a row "
             "that does not match its checksum; (None, row, column) for bytes of another number.");
}

// Front-end, odometry and attempts on the frames of a file, by the kernels as they are compiled for
// any machine; prints a hash after each. See other_machine.py, which writes the file.
#include <cstdio>
#include <cstdlib>
#include <vector>

#include "kernels/extraction.hpp"
#include "kernels/odometry.hpp"
#include "kernels/pose.hpp"
#include "kernels/quantise.hpp"

using namespace engram;

namespace {

constexpr int kLandmarks = 600, kApart = 3;

struct Hash {
  uint64_t value = 1469598103934665603ull; // FNV-1a

  void add(const void *data, size_t count) {
    for (size_t i = 0; i < count; ++i)
      value = (value ^ static_cast<const uint8_t *>(data)[i]) * 1099511628211ull;
  }

  void print(const char *what) const {
    std::printf("%s %016llx\n", what, static_cast<unsigned long long>(value));
    std::fflush(stdout);
  }
};

struct Landmarks {
  std::vector<float> pixels = std::vector<float>(2 * kLandmarks);
  std::vector<float> disparity_px = std::vector<float>(kLandmarks);
  std::vector<float> sigma_px = std::vector<float>(kLandmarks);
  std::vector<float> points = std::vector<float>(3 * kLandmarks);
  std::vector<uint64_t> descriptors = std::vector<uint64_t>(4 * kLandmarks);
  std::vector<uint8_t> octaves = std::vector<uint8_t>(kLandmarks);
};

template <class T> void read(std::FILE *file, T *data, size_t count) {
  if (std::fread(data, sizeof(T), count, file) != count) {
    std::fputs("the file of frames ends too early\n", stderr);
    std::exit(1);
  }
}

void add(Hash &hash, const PoseEstimate &estimate) {
  hash.add(&estimate.reference_from_live, sizeof estimate.reference_from_live);
  hash.add(estimate.covariance.data(), sizeof estimate.covariance);
  for (const RowPair &pair : estimate.inliers)
    hash.add(&pair, sizeof pair);
}

} // namespace

int main(int count, char **arguments) {
  std::FILE *file = count > 1 ? std::fopen(arguments[1], "rb") : nullptr;
  if (file == nullptr)
    return 2;
  int32_t head[3];
  double intrinsics[5];
  float table[256], borders[255];
  read(file, head, 3);
  read(file, intrinsics, 5);
  read(file, table, 256);
  read(file, borders, 255);
  const int frames = head[0], width = head[1], height = head[2];
  const Camera camera{intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4]};
  OdometrySettings settings;
#include "settings.inc"

  Hash hash;
  hash.print("read");
  std::vector<Landmarks> kept(static_cast<size_t>(frames));
  std::vector<FrameView> views;
  for (Landmarks &marks : kept) {
    const auto pixels = static_cast<size_t>(width) * static_cast<size_t>(height);
    std::vector<uint8_t> left(pixels), right(pixels);
    read(file, left.data(), pixels);
    read(file, right.data(), pixels);
    const auto found = generic::extract(
        {left.data(), width, height}, {right.data(), width, height}, {nullptr, width, height},
        extraction,
        {marks.pixels.data(), marks.disparity_px.data(), marks.sigma_px.data(),
         marks.descriptors.data(), marks.octaves.data()});
    const auto n = static_cast<size_t>(found.landmarks);
    generic::quantise_landmarks({found.landmarks, marks.pixels.data(), marks.disparity_px.data(),
                                 marks.sigma_px.data(), marks.points.data()},
                                {1.0f / 64, table, borders, 256}, camera);
    hash.add(marks.pixels.data(), 8 * n);
    hash.add(marks.disparity_px.data(), 4 * n);
    hash.add(marks.sigma_px.data(), 4 * n);
    hash.add(marks.points.data(), 12 * n);
    hash.add(marks.descriptors.data(), 32 * n);
    hash.add(marks.octaves.data(), n);
    views.push_back({found.landmarks, 4, marks.pixels.data(), marks.disparity_px.data(),
                     marks.sigma_px.data(), marks.points.data(), marks.descriptors.data(),
                     marks.octaves.data(), camera});
  }
  hash.print("front-end");

  OdometryState state;
  for (int k = 0; k < frames; ++k) {
    const auto motion =
        generic::odometry_step(state, settings, views[k], 100'000'000ll * (k + 1), nullptr);
    hash.add(&motion.prev_from_curr, sizeof motion.prev_from_curr);
    hash.add(motion.covariance.data(), sizeof motion.covariance);
    hash.add(&motion.inliers, sizeof motion.inliers);
  }
  hash.print("odometry");

  for (int k = 0; k + kApart < frames; ++k)
    add(hash, generic::attempt(views[k], views[k + kApart], settings.match,
                               static_cast<uint64_t>(k), nullptr));
  hash.print("attempts");
}

#include "kernels/tracked_window.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "kernels/doubt.hpp"
#include "kernels/twist.hpp"
#include "kernels/window_ba.hpp"

namespace engram::ENGRAM_ISA {
namespace {

constexpr int32_t kUnseen = -1;

template <class T> void copy(const T *from, int64_t count, std::vector<T> &to) {
  to.assign(from, from + count);
}

KeptFrame kept(const FrameView &frame, const RigidTransform &world_from_cam,
               const OdometrySettings &settings) {
  KeptFrame copied;
  copied.width = frame.width;
  copied.camera = frame.camera;
  copied.world_from_cam = world_from_cam;
  copy(frame.pixels, 2 * frame.count, copied.pixels);
  copy(frame.disparity_px, frame.count, copied.disparity_px);
  copy(frame.disparity_sigma_px, frame.count, copied.disparity_sigma_px);
  copy(frame.points_in_cam, 3 * frame.count, copied.points_in_cam);
  copy(frame.descriptors, frame.width * frame.count, copied.descriptors);
  copy(frame.octaves, frame.count, copied.octaves);
  copied.tracks.assign(static_cast<size_t>(frame.count), kUnseen);
  copied.window_pixel_sigma_px.resize(static_cast<size_t>(frame.count));
  copied.window_disparity_sigma_px.resize(static_cast<size_t>(frame.count));
  // By octave: a corner's error grows with the square root of the octave's scale.
  std::array<float, 256> pixel_sigma_px;
  double growth = 1;
  for (float &sigma_px : pixel_sigma_px) {
    sigma_px = static_cast<float>(settings.window_pixel_sigma_px * growth);
    growth *= std::sqrt(settings.match.octave_scale);
  }
  const double more = static_cast<float>(settings.window_disparity_sigma_px);
  for (int64_t i = 0; i < frame.count; ++i) {
    const double own = frame.disparity_sigma_px[i];
    copied.window_pixel_sigma_px[i] = pixel_sigma_px[frame.octaves[i]];
    copied.window_disparity_sigma_px[i] = static_cast<float>(std::sqrt(own * own + more * more));
  }
  return copied;
}

std::vector<KeptFrame *> frames_of(OdometryWindow &window) {
  std::vector<KeptFrame *> frames;
  for (KeptFrame &frame : window.keyframes)
    frames.push_back(&frame);
  if (window.newest)
    frames.push_back(&*window.newest);
  return frames;
}

// How many frames hold each track. Those that none holds any more lose their numbers, so that
// nothing grows with the time driven.
std::vector<int32_t> living_tracks(OdometryWindow &window, const std::vector<KeptFrame *> &frames) {
  std::vector<int32_t> length(static_cast<size_t>(window.tracks), 0);
  for (const KeptFrame *frame : frames)
    for (const int32_t track : frame->tracks)
      if (track != kUnseen)
        ++length[track];
  std::vector<int32_t> number(length.size(), kUnseen);
  int32_t living = 0;
  for (size_t track = 0; track < length.size(); ++track)
    if (length[track] > 0) {
      number[track] = living;
      length[living++] = length[track];
    }
  if (living < window.tracks)
    for (KeptFrame *frame : frames)
      for (int32_t &track : frame->tracks)
        if (track != kUnseen)
          track = number[track];
  window.tracks = living;
  length.resize(static_cast<size_t>(living));
  return length;
}

// The longest tracks, numbered from 0, of equal ones the older first; `kUnseen` for those seen
// once and, beyond `most`, the shortest. Returns how many there are.
int32_t number_longest(const std::vector<int32_t> &length, int32_t longest, int32_t most,
                       std::vector<int32_t> &number) {
  number.assign(length.size(), kUnseen);
  int32_t next = 0;
  for (int32_t wanted = longest; wanted >= 2; --wanted)
    for (size_t track = 0; track < length.size() && next < most; ++track)
      if (length[track] == wanted)
        number[track] = next++;
  return next;
}

// The observations of numbered tracks, in the order of frames and rows.
struct Gathered {
  std::vector<int32_t> frame, track;
  std::vector<float> stereo, pixel_sigma_px, disparity_sigma_px;

  void gather(const std::vector<KeptFrame *> &frames, const std::vector<int32_t> &number) {
    size_t count = 0;
    for (const KeptFrame *one : frames)
      count += one->tracks.size();
    frame.resize(count);
    track.resize(count);
    stereo.resize(3 * count);
    pixel_sigma_px.resize(count);
    disparity_sigma_px.resize(count);
    size_t k = 0;
    for (size_t p = 0; p < frames.size(); ++p) {
      const KeptFrame &from = *frames[p];
      for (size_t row = 0; row < from.tracks.size(); ++row) {
        if (from.tracks[row] == kUnseen || number[from.tracks[row]] == kUnseen)
          continue;
        frame[k] = static_cast<int32_t>(p);
        track[k] = number[from.tracks[row]];
        stereo[3 * k] = from.pixels[2 * row];
        stereo[3 * k + 1] = from.pixels[2 * row + 1];
        stereo[3 * k + 2] = from.disparity_px[row];
        pixel_sigma_px[k] = from.window_pixel_sigma_px[row];
        disparity_sigma_px[k] = from.window_disparity_sigma_px[row];
        ++k;
      }
    }
    count_ = static_cast<int64_t>(k);
  }

  WindowObservations view(int32_t tracks) const {
    return {count_,         frame.data(), track.data(), stereo.data(), pixel_sigma_px.data(),
            disparity_sigma_px.data(), tracks};
  }

private:
  int64_t count_ = 0;
};

// Covariance, in the world, of the last pose relative to the one before it. The last block belongs
// to the newest frame; without a block before it the keyframe is held.
std::array<double, 36> covariance_of_last_step(const WindowResult &adjusted, size_t free) {
  const size_t size = 6 * free;
  const auto block = [&](size_t row, size_t column, int at) {
    return adjusted.covariance[(row + at / 6) * size + column + at % 6];
  };
  std::array<double, 36> step;
  const size_t newest = size - 6;
  for (int i = 0; i < 36; ++i) {
    step[i] = block(newest, newest, i);
    if (free > 1) {
      const size_t key = newest - 6;
      step[i] = step[i] + block(key, key, i) - block(key, newest, i) -
                block(key, newest, 6 * (i % 6) + i / 6);
    }
  }
  return step;
}

} // namespace

OdometryWindow begin_window(const FrameView &first, const OdometrySettings &settings,
                            double offset_px) {
  OdometryWindow window;
  window.keyframes.push_back(kept(first, RigidTransform{}, settings));
  window.offset_px = offset_px;
  return window;
}

void add_to_window(OdometryWindow &window, const FrameView &frame, const PoseEstimate &match,
                   const OdometrySettings &settings) {
  KeptFrame &key = window.keyframes.back();
  window.newest =
      kept(frame, compose(key.world_from_cam, match.reference_from_live), settings);
  for (const RowPair &pair : match.inliers) {
    int32_t &track = key.tracks[pair.reference];
    if (track == kUnseen)
      track = window.tracks++;
    window.newest->tracks[pair.live] = track;
  }
}

void keep_newest(OdometryWindow &window, const OdometrySettings &settings) {
  window.keyframes.push_back(std::move(*window.newest));
  window.newest.reset();
  if (window.keyframes.size() >= static_cast<size_t>(settings.window_frames))
    window.keyframes.erase(window.keyframes.begin());
}

PlacedPose optimise_window(OdometryWindow &window, const PoseEstimate &match,
                           const OdometrySettings &settings) {
  const PlacedPose matched{match.reference_from_live, match.covariance, match.covariance};
  const std::vector<KeptFrame *> frames = frames_of(window);
  const std::vector<int32_t> length = living_tracks(window, frames);
  if (settings.window_iterations == 0)
    return matched;
  static thread_local std::vector<int32_t> number;
  static thread_local Gathered gathered;
  const int32_t tracks = number_longest(length, static_cast<int32_t>(frames.size()),
                                        settings.window_landmarks, number);
  gathered.gather(frames, number);
  std::vector<RigidTransform> poses;
  for (const KeptFrame *frame : frames)
    poses.push_back(frame->world_from_cam);
  const WindowResult adjusted =
      adjust_window(frames.back()->camera, poses, gathered.view(tracks),
                    {1, settings.window_iterations, settings.match.chi2, window.offset_px,
                     settings.window_offset_sigma_px});
  if (!adjusted.solved)
    return matched;
  window.offset_px = adjusted.offset_px;
  for (size_t p = 0; p < frames.size(); ++p)
    frames[p]->world_from_cam = adjusted.world_from_cam[p];
  const RigidTransform keyframe_from_world = inverse(adjusted.world_from_cam[frames.size() - 2]);
  PlacedPose placed{compose(keyframe_from_world, adjusted.world_from_cam.back()),
                    carried(keyframe_from_world,
                            covariance_of_last_step(adjusted, frames.size() - 1)),
                    {}};
  const auto inliers = static_cast<double>(match.inliers.size());
  placed.searched = searched(placed.covariance, inliers, settings.match);
  const double growth = growth_of_few(settings.few_inliers, inliers);
  for (double &entry : placed.covariance)
    entry *= growth;
  return placed;
}

} // namespace engram::ENGRAM_ISA

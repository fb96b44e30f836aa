// Where left and right differ in brightness or contrast: one lens dirty, fogged or in the sun, own
// exposures, a filter. By how much, and images freed of both.
#pragma once

#include "dispatch.hpp"
#include "kernels/image.hpp"

ENGRAM_DECLARE_KERNELS(
    // By how much the sides differ in brightness and contrast, as a share of the contrast: a
    // quarter of the picture differs by more. 0 where nothing tells it. Halved images are given;
    // the mask is of the left image at full size.
    //
    // Windows of 160×80 px of the right image are compared with the left one at all disparities, by
    // mean and standard deviation; of each counts the disparity at which they differ least, so that
    // what lies nearer or farther is no difference. A window that may show the body says nothing.
    float side_difference(const Image &left_half, const Image &right_half, const Mask &mask,
                          int max_disparity_px);

    // Frees an image of its local brightness and contrast: each pixel's distance from the mean of
    // the 15×15 window about it, in standard deviations of that, about the middle grey.
    void even_contrast(const Image &image, uint8_t *evened);)

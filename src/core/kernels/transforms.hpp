// What a robot does with rigid transforms and their covariances from frame to frame.
//
// A transform is 12 numbers: its rotation row by row, then its translation. Tangents are
// [translation, rotation]. Sums of products are chains of fused multiply-adds, as the usual linear
// algebra libraries have them on x86-64, so that results are NumPy's, on every instruction set.
#pragma once

#include "dispatch.hpp"

ENGRAM_DECLARE_KERNELS(
    // a_from_b · b_from_c, and its covariance (6 × 6) to first order, both errors independent.
    void chain(const double *a_from_b, const double *covariance_ab, const double *b_from_c,
               const double *covariance_bc, double *a_from_c, double *covariance_ac);

    // The transform of a tangent vector (6).
    void transform_of(const double *tangent, double *transform);

    // Sine and cosine of a rotation's angle.
    void turn_of(const double *rotation, double *sine, double *cosine);

    // The tangent vector (6) of a transform, given the angle (in [0, π]) that turn_of() tells.
    void tangent_of(const double *transform, double angle, double *tangent);

    // One Newton step from a matrix (9) that is nearly a rotation to the nearest rotation.
    void orthonormalise(const double *matrix, double *rotation);)

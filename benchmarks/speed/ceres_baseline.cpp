// Both passes of the paper's objective (Eq. 5) in Ceres: automatic differentiation, Cauchy loss on
// each correspondence, both priors, one thread. Compiled and run by benchmarks/speed/ceres.py.
//
//   ceres_baseline PROBLEM
//
// PROBLEM holds doubles: cameras, rows, scale [px], lambda, mu; per camera fx fy cx cy and the 16
// of T_camera_lidar (start and mean of the priors); per row camera, x y z, u v, and 1 if the second
// pass keeps it. Prints wall and processor seconds, then T_camera_lidar of every camera after each
// pass: angle-axis and translation.

#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <vector>

namespace {

using Pose = std::array<double, 6>;  // angle-axis, translation: p_camera = R p_lidar + t

struct Camera {
  double fx, fy, cx, cy;
  double T[16];  // row by row
};

struct Row {
  double camera, point[3], pixel[2], kept;
};

struct Input {
  double scale, prior, relative_prior;
  std::vector<Camera> cameras;
  std::vector<Row> rows;
};

// A transform as R (column by column, as Ceres has it) and t.
template <typename T>
struct Rigid {
  T R[9], t[3];
};

template <typename T>
Rigid<T> to_rigid(const T* pose) {
  Rigid<T> out;
  ceres::AngleAxisToRotationMatrix(pose, out.R);
  for (int i = 0; i < 3; ++i) out.t[i] = pose[3 + i];
  return out;
}

template <typename T>
Rigid<T> to_rigid(const Camera& camera) {
  Rigid<T> out;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) out.R[3 * j + i] = T(camera.T[4 * i + j]);
    out.t[i] = T(camera.T[4 * i + 3]);
  }
  return out;
}

template <typename T>
Rigid<T> compose(const Rigid<T>& a, const Rigid<T>& b) {
  Rigid<T> out;
  for (int i = 0; i < 3; ++i) {
    out.t[i] = a.t[i];
    for (int k = 0; k < 3; ++k) out.t[i] += a.R[3 * k + i] * b.t[k];
    for (int j = 0; j < 3; ++j) {
      out.R[3 * j + i] = T(0);
      for (int k = 0; k < 3; ++k) out.R[3 * j + i] += a.R[3 * k + i] * b.R[3 * j + k];
    }
  }
  return out;
}

template <typename T>
Rigid<T> invert(const Rigid<T>& a) {
  Rigid<T> out;
  for (int i = 0; i < 3; ++i) {
    out.t[i] = T(0);
    for (int j = 0; j < 3; ++j) {
      out.R[3 * j + i] = a.R[3 * i + j];
      out.t[i] -= a.R[3 * i + j] * a.t[j];
    }
  }
  return out;
}

// The logarithm of SE(3), rotation first, times a factor.
template <typename T>
void scaled_log(const Rigid<T>& a, double factor, T* out) {
  T w[3], wt[3], wwt[3];
  ceres::RotationMatrixToAngleAxis(a.R, w);
  const T square = ceres::DotProduct(w, w);
  T c = T(1.0 / 12.0) + square / 720.0;  // of (1 - x sin x / (2 (1 - cos x))) / x^2
  if (square > 1e-4) {
    const T angle = sqrt(square);
    c = (1.0 - angle * sin(angle) / (2.0 * (1.0 - cos(angle)))) / square;
  }
  ceres::CrossProduct(w, a.t, wt);
  ceres::CrossProduct(w, wt, wwt);
  for (int i = 0; i < 3; ++i) {
    out[i] = factor * w[i];
    out[3 + i] = factor * (a.t[i] - 0.5 * wt[i] + c * wwt[i]);
  }
}

struct Reprojection {
  const Camera& camera;
  const Row& row;

  template <typename T>
  bool operator()(const T* pose, T* residual) const {
    const T point[3] = {T(row.point[0]), T(row.point[1]), T(row.point[2])};
    T p[3];
    ceres::AngleAxisRotatePoint(pose, point, p);
    for (int i = 0; i < 3; ++i) p[i] += pose[3 + i];
    residual[0] = camera.fx * p[0] / p[2] + camera.cx - row.pixel[0];
    residual[1] = camera.fy * p[1] / p[2] + camera.cy - row.pixel[1];
    return true;
  }
};

struct Prior {
  const Camera& hat;
  double root;

  template <typename T>
  bool operator()(const T* pose, T* residual) const {
    scaled_log(compose(invert(to_rigid<T>(hat)), to_rigid(pose)), root, residual);
    return true;
  }
};

struct RelativePrior {
  const Camera &hat_a, &hat_b;
  double root;

  template <typename T>
  bool operator()(const T* a, const T* b, T* residual) const {
    const Rigid<T> hat = compose(to_rigid<T>(hat_b), invert(to_rigid<T>(hat_a)));
    const Rigid<T> now = compose(to_rigid(b), invert(to_rigid(a)));
    scaled_log(compose(invert(hat), now), root, residual);
    return true;
  }
};

Input read(const char* path) {
  std::ifstream file(path, std::ios::binary);
  double head[5];
  file.read(reinterpret_cast<char*>(head), sizeof head);
  Input input{head[2], head[3], head[4], {}, {}};
  input.cameras.resize(static_cast<size_t>(head[0]));
  input.rows.resize(static_cast<size_t>(head[1]));
  file.read(reinterpret_cast<char*>(input.cameras.data()), input.cameras.size() * sizeof(Camera));
  file.read(reinterpret_cast<char*>(input.rows.data()), input.rows.size() * sizeof(Row));
  if (!file) {
    std::fprintf(stderr, "%s: too short\n", path);
    std::exit(1);
  }
  return input;
}

void minimize(const Input& input, bool kept_only, std::vector<Pose>& poses) {
  ceres::Problem problem;
  auto* loss = new ceres::CauchyLoss(input.scale);
  for (auto& pose : poses) problem.AddParameterBlock(pose.data(), 6);
  for (const Row& row : input.rows) {
    if (kept_only && row.kept == 0.0) continue;
    const auto c = static_cast<size_t>(row.camera);
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Reprojection, 2, 6>(
                                 new Reprojection{input.cameras[c], row}),
                             loss, poses[c].data());
  }
  for (size_t c = 0; c < poses.size(); ++c) {
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Prior, 6, 6>(
                                 new Prior{input.cameras[c], std::sqrt(input.prior)}),
                             nullptr, poses[c].data());
    if (c == 0) continue;
    problem.AddResidualBlock(
        new ceres::AutoDiffCostFunction<RelativePrior, 6, 6, 6>(new RelativePrior{
            input.cameras[c - 1], input.cameras[c], std::sqrt(input.relative_prior)}),
        nullptr, poses[c - 1].data(), poses[c].data());
  }
  ceres::Solver::Options options;
  // Dense Cholesky of the cameras that are left after every other one is eliminated. As fast as
  // DENSE_NORMAL_CHOLESKY with two cameras, several times as fast with twelve: no dense Jacobian.
  options.linear_solver_type = ceres::DENSE_SCHUR;
  options.num_threads = 1;
  options.function_tolerance = 1e-8;  // at the default of 1e-6 it stops above the others' costs
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  ceres::Solve(options, &problem, &summary);
  if (!summary.IsSolutionUsable()) {
    std::fprintf(stderr, "%s\n", summary.BriefReport().c_str());
    std::exit(1);
  }
}

void print(const std::vector<Pose>& poses) {
  for (const Pose& pose : poses)
    for (double value : pose) std::printf("%.17g\n", value);
}

}  // namespace

int main(int count, char** arguments) {
  if (count != 2) {
    std::fprintf(stderr, "usage: ceres_baseline PROBLEM\n");
    return 2;
  }
  const Input input = read(arguments[1]);
  std::vector<Pose> first, second;
  const auto wall = std::chrono::steady_clock::now();
  const std::clock_t cpu = std::clock();
  for (const Camera& camera : input.cameras) {
    const Rigid<double> T = to_rigid<double>(camera);
    Pose pose = {0, 0, 0, T.t[0], T.t[1], T.t[2]};
    ceres::RotationMatrixToAngleAxis(T.R, pose.data());
    first.push_back(pose);
  }
  minimize(input, false, first);
  second = first;
  minimize(input, true, second);
  const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - wall;
  std::printf("%.9f\n%.9f\n", seconds.count(),
              static_cast<double>(std::clock() - cpu) / CLOCKS_PER_SEC);
  print(first);
  print(second);
  return 0;
}

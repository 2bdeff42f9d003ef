// The step of a 15-state unscented filter as compiled robots run it: a stand-in for robot_localization's UKF core (3.6), written anew.
//
// Same state, process and order of work: matrices of a size known at run time, 31 sigma points each moved by a transfer matrix of its own,
// measurements through a selection matrix, the points of the prediction reused in the first correction after it. No ROS, no logging.
// The posterior subtracts the whole innovation covariance, which that core does not; it costs the same.
//
//   eigen_ukf15 EVENTS    doubles by event: dt, m, then five of each: index, value, variance (unused ones 0)
//
// It prints the CPU seconds of filtering, without reading, and the final state. benchmarks/fuse.py compiles it (-O2) and calls it.

#include <Eigen/Dense>
#include <cmath>
#include <cstdio>
#include <ctime>
#include <vector>

namespace {

constexpr int kStates = 15;
constexpr int kEntries = 17;  // of an event in the file

class Filter {
 public:
  Filter()
      : points_(2 * kStates + 1, Eigen::VectorXd(kStates)), transfer_(Eigen::MatrixXd::Identity(kStates, kStates)),
        state_(Eigen::VectorXd::Zero(kStates)), covariance_(0.01 * Eigen::MatrixXd::Identity(kStates, kStates)),
        mean_weight_(points_.size(), 0.5 / kStates), covariance_weight_(mean_weight_) {
    mean_weight_[0] = 0.0;  // alpha = 1, kappa = 0, beta = 2
    covariance_weight_[0] = 2.0;
  }

  void Predict(double dt, const Eigen::VectorXd& noise) {
    Draw();
    for (auto& point : points_) Move(point, dt);
    state_.setZero();
    for (size_t i = 0; i < points_.size(); ++i) state_.noalias() += mean_weight_[i] * points_[i];
    covariance_.setZero();
    Eigen::VectorXd apart(kStates);
    for (size_t i = 0; i < points_.size(); ++i) {
      apart = points_[i] - state_;
      covariance_.noalias() += covariance_weight_[i] * (apart * apart.transpose());
    }
    covariance_.diagonal() += dt * noise;
    fresh_ = true;
  }

  void Correct(int size, const double* index, const double* value, const double* variance) {
    if (!fresh_) Draw();
    Eigen::MatrixXd select = Eigen::MatrixXd::Zero(size, kStates);
    Eigen::VectorXd measured(size), expected = Eigen::VectorXd::Zero(size), apart(size);
    Eigen::MatrixXd innovation = Eigen::MatrixXd::Zero(size, size), cross = Eigen::MatrixXd::Zero(kStates, size);
    for (int k = 0; k < size; ++k) {
      select(k, static_cast<int>(index[k])) = 1.0;
      measured(k) = value[k];
    }
    std::vector<Eigen::VectorXd> seen(points_.size(), Eigen::VectorXd(size));
    for (size_t i = 0; i < points_.size(); ++i) {
      seen[i] = select * points_[i];
      expected.noalias() += mean_weight_[i] * seen[i];
    }
    for (size_t i = 0; i < points_.size(); ++i) {
      apart = seen[i] - expected;
      innovation.noalias() += covariance_weight_[i] * (apart * apart.transpose());
      cross.noalias() += covariance_weight_[i] * ((points_[i] - state_) * apart.transpose());
    }
    for (int k = 0; k < size; ++k) innovation(k, k) += variance[k];
    const Eigen::MatrixXd inverse = innovation.inverse();
    const Eigen::MatrixXd gain = cross * inverse;
    Eigen::VectorXd left = measured - expected;
    for (int k = 0; k < size; ++k)
      if (index[k] >= 3 && index[k] < 6) left(k) = Wrapped(left(k));
    if (left.dot(inverse * left) > 1e12) return;  // the gate, wide open
    state_.noalias() += gain * left;
    covariance_.noalias() -= gain * innovation * gain.transpose();
    for (int k = 3; k < 6; ++k) state_(k) = Wrapped(state_(k));
    fresh_ = false;
  }

  const Eigen::VectorXd& state() const { return state_; }

 private:
  static double Wrapped(double angle) {
    while (angle < -M_PI) angle += 2 * M_PI;
    while (angle > M_PI) angle -= 2 * M_PI;
    return angle;
  }

  void Draw() {
    root_ = (kStates * covariance_).llt().matrixL();
    points_[0] = state_;
    for (int i = 0; i < kStates; ++i) {
      points_[i + 1] = state_ + root_.col(i);
      points_[i + 1 + kStates] = state_ - root_.col(i);
    }
  }

  void Move(Eigen::VectorXd& point, double dt) {
    const double sr = std::sin(point(3)), cr = std::cos(point(3)), sp = std::sin(point(4)), cp = std::cos(point(4));
    const double sy = std::sin(point(5)), cy = std::cos(point(5)), tp = sp / cp, half = 0.5 * dt;
    const double rotation[3][3] = {{cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr},
                                   {sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr},
                                   {-sp, cp * sr, cp * cr}};
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) {
        transfer_(i, 6 + j) = dt * rotation[i][j];
        transfer_(i, 12 + j) = half * dt * rotation[i][j];
      }
      transfer_(6 + i, 12 + i) = dt;
    }
    transfer_(3, 9) = dt;
    transfer_(3, 10) = sr * tp * dt;
    transfer_(3, 11) = cr * tp * dt;
    transfer_(4, 10) = cr * dt;
    transfer_(4, 11) = -sr * dt;
    transfer_(5, 10) = sr / cp * dt;
    transfer_(5, 11) = cr / cp * dt;
    point.applyOnTheLeft(transfer_);
  }

  std::vector<Eigen::VectorXd> points_;
  Eigen::MatrixXd transfer_, root_;
  Eigen::VectorXd state_;
  Eigen::MatrixXd covariance_;
  std::vector<double> mean_weight_, covariance_weight_;
  bool fresh_ = false;
};

}  // namespace

int main(int argc, char** argv) {
  std::FILE* file = argc == 2 ? std::fopen(argv[1], "rb") : nullptr;
  double noise[kStates];
  if (!file || std::fread(noise, sizeof(double), kStates, file) != kStates) {
    std::fprintf(stderr, "usage: eigen_ukf15 EVENTS (doubles: 15 process variances a second, then 17 an event)\n");
    return 2;
  }
  std::vector<double> events;
  double event[kEntries];
  while (std::fread(event, sizeof(double), kEntries, file) == kEntries) events.insert(events.end(), event, event + kEntries);
  std::fclose(file);
  const Eigen::VectorXd density = Eigen::Map<Eigen::VectorXd>(noise, kStates);
  Filter filter;
  const std::clock_t begin = std::clock();
  for (size_t at = 0; at < events.size(); at += kEntries) {
    if (events[at] > 0.0) filter.Predict(events[at], density);
    filter.Correct(static_cast<int>(events[at + 1]), &events[at + 2], &events[at + 7], &events[at + 12]);
  }
  std::printf("%.6f", static_cast<double>(std::clock() - begin) / CLOCKS_PER_SEC);
  for (int k = 0; k < kStates; ++k) std::printf(" %.12g", filter.state()(k));
  std::printf("\n");
  return 0;
}

// A component that reads what a dressing robot wants: points with normals and clearance, and the end of a sleeve.
//
//   ros2 run refu_listener_cpp sleeve_listener_node
//   ros2 component load /ComponentManager refu_listener_cpp refu_listener::SleeveListener
//
// The node computes only what somebody subscribes to.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include <geometry_msgs/msg/polygon_stamped.hpp>
#include <geometry_msgs/msg/vector3_stamped.hpp>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_components/register_node_macro.hpp>
#include <sensor_msgs/msg/point_cloud2.hpp>
#include <sensor_msgs/point_cloud2_iterator.hpp>

namespace refu_listener
{

class SleeveListener : public rclcpp::Node
{
public:
  explicit SleeveListener(const rclcpp::NodeOptions & options)
  : Node("sleeve_listener", options)
  {
    normal_ = create_publisher<geometry_msgs::msg::Vector3Stamped>("sleeve_normal", 1);
    opening_ = create_subscription<geometry_msgs::msg::PolygonStamped>(
      "openings/tshirt_male/left_sleeve", 1,
      [this](const geometry_msgs::msg::PolygonStamped & message) {on_opening(message);});
    points_ = create_subscription<sensor_msgs::msg::PointCloud2>(
      "points", 1, [this](const sensor_msgs::msg::PointCloud2 & message) {on_points(message);});
  }

private:
  // The rim is counter-clockwise as seen from outside: its area points out of the garment.
  void on_opening(const geometry_msgs::msg::PolygonStamped & message)
  {
    const auto & rim = message.polygon.points;
    geometry_msgs::msg::Vector3Stamped out;
    out.header = message.header;
    for (std::size_t i = 0; i < rim.size(); ++i) {
      const auto & a = rim[i];
      const auto & b = rim[(i + 1) % rim.size()];
      out.vector.x += static_cast<double>(a.y) * b.z - static_cast<double>(a.z) * b.y;
      out.vector.y += static_cast<double>(a.z) * b.x - static_cast<double>(a.x) * b.z;
      out.vector.z += static_cast<double>(a.x) * b.y - static_cast<double>(a.y) * b.x;
    }
    const double length = std::hypot(out.vector.x, out.vector.y, out.vector.z);
    if (length > 0.0) {
      out.vector.x /= length;
      out.vector.y /= length;
      out.vector.z /= length;
      normal_->publish(out);
    }
  }

  void on_points(const sensor_msgs::msg::PointCloud2 & message)
  {
    sensor_msgs::PointCloud2ConstIterator<float> clearance(message, "clearance");
    sensor_msgs::PointCloud2ConstIterator<std::uint8_t> garment(message, "garment");
    float least = std::numeric_limits<float>::max();
    for (; clearance != clearance.end(); ++clearance, ++garment) {
      if (*garment == 0) {
        least = std::min(least, *clearance);
      }
    }
    RCLCPP_INFO_THROTTLE(
      get_logger(), *get_clock(), 1000, "the nearest cloth is %.1f mm off the skin", 1e3 * least);
  }

  rclcpp::Publisher<geometry_msgs::msg::Vector3Stamped>::SharedPtr normal_;
  rclcpp::Subscription<geometry_msgs::msg::PolygonStamped>::SharedPtr opening_;
  rclcpp::Subscription<sensor_msgs::msg::PointCloud2>::SharedPtr points_;
};

}  // namespace refu_listener

RCLCPP_COMPONENTS_REGISTER_NODE(refu_listener::SleeveListener)

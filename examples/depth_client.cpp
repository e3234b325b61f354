// Prints depth frames: g++ -o depth_client depth_client.cpp
// mavfi fly --companion "./depth_client {camera} 10"
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <sys/socket.h>
#include <sys/un.h>
#include <vector>

struct Header {  // 56 bytes without padding, little-endian
    char magic[8];
    uint64_t stamp_us;
    uint32_t columns, rows;
    float hfov_rad, position_enu_m[3], quaternion_wxyz[4];
};

int main(int count, char **arguments) {
    if (count != 3) return 2;
    sockaddr_un address{AF_UNIX, {}};
    std::strncpy(address.sun_path, arguments[1], sizeof address.sun_path - 1);
    int link = socket(AF_UNIX, SOCK_STREAM, 0);
    if (connect(link, reinterpret_cast<sockaddr *>(&address), sizeof address)) return 1;
    std::vector<float> depth_m;
    Header h;
    for (int left = std::atoi(arguments[2]); left > 0; --left) {
        if (recv(link, &h, sizeof h, MSG_WAITALL) != sizeof h) return 1;
        if (std::memcmp(h.magic, "MAVFI-D1", 8) || h.columns - 1 > 2047 || h.rows - 1 > 2047) return 1;
        depth_m.resize(h.columns * h.rows);
        ssize_t size = depth_m.size() * sizeof(float);
        if (recv(link, depth_m.data(), size, MSG_WAITALL) != size) return 1;
        float nearest_m = *std::min_element(depth_m.begin(), depth_m.end()), *at = h.position_enu_m;
        std::printf("%lu %u %u %.1f m, at %.2f %.2f %.2f\n", h.stamp_us, h.rows, h.columns,
                    nearest_m, at[0], at[1], at[2]);
    }
}

// SPDX-License-Identifier: Apache-2.0
// CURVE keys, and who may connect over tcp. Key directories are those of Python (`cortex keys new`): `key.secret`,
// `key.public`, and `authorized_keys`, the public keys of those we talk to, one a line, each perhaps with host names.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iterator>
#include <map>
#include <memory>
#include <set>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <sys/stat.h>
#include <unistd.h>

#include <zmq.hpp>

#include "cortex/socket.hpp"

namespace cortex {

constexpr std::size_t key_length = 40;

// Whether a text is a key in Z85.
inline bool is_key(std::string_view text) {
  constexpr std::string_view z85 = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#";
  return text.size() == key_length && text.find_first_not_of(z85) == std::string_view::npos;
}

class Keys {
 public:
  // Throws std::runtime_error if a key is missing, is none, or could be read or changed by others. A path may begin with "~/".
  explicit Keys(const std::string& directory) : directory_(expand(directory)) {
    secret_ = first_word(read_private("key.secret", 077));
    public_ = first_word(read(directory_ + "/key.public"));
    if (!is_key(secret_) || !is_key(public_)) {  // never named: it may be the secret
      throw std::runtime_error(directory_ + ": a key must be 40 characters of Z85");
    }
    std::array<char, key_length + 1> belongs{};
    if (zmq_curve_public(belongs.data(), secret_.c_str()) != 0 || public_ != belongs.data()) {
      throw std::runtime_error(directory_ + ": the secret key does not belong to the public key");
    }
    authorized();
  }

  const std::string& public_key() const noexcept { return public_; }

  // Whether a public key is authorised now: the list is read anew, so a key can be revoked.
  bool allows(const std::string& key) const { return key == public_ || authorized().count(key) != 0; }

  // The public key of a host that the list names, else our own.
  std::string of_host(const std::string& host) const {
    for (const auto& [key, hosts] : authorized()) {
      if (std::find(hosts.begin(), hosts.end(), host) != hosts.end()) return key;
    }
    return public_;
  }

  // Makes a socket, before it connects, speak CURVE to the server that has this key.
  void apply_client(zmq::socket_t& socket, const std::string& server_key) const {
    socket.set(zmq::sockopt::curve_publickey, public_);
    socket.set(zmq::sockopt::curve_secretkey, secret_);
    socket.set(zmq::sockopt::curve_serverkey, server_key);
  }

  // Makes a socket take in authorised CURVE clients only at the addresses that it binds from now on. Its context must have
  // an `Authenticator` as long as it lives: libzmq lets everybody in where nobody decides.
  void apply_server(zmq::socket_t& socket) const {
    socket.set(zmq::sockopt::curve_secretkey, secret_);
    socket.set(zmq::sockopt::curve_publickey, public_);
    socket.set(zmq::sockopt::curve_server, true);
    socket.set(zmq::sockopt::zap_domain, std::string("cortex"));
  }

 private:
  static std::string read(const std::string& path) {
    std::ifstream file(path);
    if (!file) throw std::runtime_error("cannot read " + path + ": " + std::strerror(errno));
    return {std::istreambuf_iterator<char>(file), {}};
  }

  std::string read_private(const std::string& name, mode_t forbidden) const {
    const std::string path = directory_ + "/" + name;
    struct stat status {};
    if (::stat(path.c_str(), &status) != 0) throw std::runtime_error("cannot read " + path + ": " + std::strerror(errno));
    if (status.st_uid != ::getuid() && status.st_uid != 0) {
      throw std::runtime_error(path + " belongs to user " + std::to_string(status.st_uid) + ", not to us");
    }
    if ((status.st_mode & forbidden) != 0) throw std::runtime_error(path + " is open to others: chmod go-rwx " + path);
    return read(path);
  }

  static std::string expand(const std::string& path) {
    const char* home = std::getenv("HOME");
    return home != nullptr && path.rfind("~/", 0) == 0 ? home + path.substr(1) : path;
  }

  static std::string first_word(const std::string& text) {
    std::string word;
    std::istringstream(text) >> word;
    return word;
  }

  std::map<std::string, std::vector<std::string>> authorized() const {
    std::map<std::string, std::vector<std::string>> known;
    if (::access((directory_ + "/authorized_keys").c_str(), F_OK) != 0) return known;
    std::istringstream lines(read_private("authorized_keys", 022));
    for (std::string line; std::getline(lines, line);) {
      std::istringstream words(line);
      std::string key;
      words >> key;
      if (is_key(key)) {  // one may begin with "#"; one that is commented out has 41 characters
        known[key] = {std::istream_iterator<std::string>(words), {}};
      } else if (!key.empty() && key.front() != '#') {
        throw std::runtime_error(directory_ + "/authorized_keys must hold keys and comments, got '" + key + "'");
      }
    }
    return known;
  }

  std::string directory_;
  std::string public_;
  std::string secret_;
};

// Lets CURVE clients in or refuses them (ZAP, ZeroMQ RFC 27), as the one place of a context.
class Authenticator {
 public:
  Authenticator(zmq::context_t& context, std::shared_ptr<const Keys> keys, std::shared_ptr<net::Complaints> complaints)
      : keys_(std::move(keys)), complaints_(std::move(complaints)), socket_(context, zmq::socket_type::rep) {
    socket_.set(zmq::sockopt::linger, 0);
    socket_.bind("inproc://zeromq.zap.01");
  }

  int fd() { return socket_.get(zmq::sockopt::fd); }

  // Answers those that wait.
  void serve() {
    while (true) {
      std::vector<std::string> request;
      zmq::message_t part;
      while (socket_.recv(part, zmq::recv_flags::dontwait)) {
        request.push_back(part.to_string());
        if (!part.more()) break;
      }
      if (request.empty()) return;
      request.resize(std::max<std::size_t>(request.size(), 7));
      const std::string key = key_of(request);
      const bool allowed = !key.empty();
      const std::array<std::string, 6> reply{"1.0", request[1], allowed ? "200" : "400",
                                             allowed ? "OK" : "not authorised", key, ""};
      for (std::size_t index = 0; index < reply.size(); ++index) {
        const auto more = index + 1 < reply.size() ? zmq::send_flags::sndmore : zmq::send_flags::none;
        socket_.send(zmq::buffer(reply[index]), more);
      }
    }
  }

 private:
  // The key of a request, if it is authorised; else nothing.
  std::string key_of(const std::vector<std::string>& request) {
    if (request[0] != "1.0" || request[2] != "cortex" || request[5] != "CURVE" || request[6].size() != 32) return "";
    std::array<char, key_length + 1> text{};
    zmq_z85_encode(text.data(), reinterpret_cast<const std::uint8_t*>(request[6].data()), request[6].size());
    const std::string key(text.data());
    try {
      if (keys_->allows(key)) return key;
      complaints_->once("key " + key, "refused key " + key + " of " + request[3] + ": it is not authorised");
    } catch (const std::exception& error) {
      complaints_->once("keys", std::string("nobody can connect: ") + error.what());
    }
    return "";
  }

  std::shared_ptr<const Keys> keys_;
  std::shared_ptr<net::Complaints> complaints_;
  zmq::socket_t socket_;
};

}  // namespace cortex

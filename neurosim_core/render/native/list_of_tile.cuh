// The candidate list of `tile` for the instants around `first`.
const auto& lists = view.candidates;
const int list_group = first / lists.instants;
const int begin = (list_group * lists.bounds.shape[0] + tile) * lists.limit;
const int count = *wp::address(lists.count, list_group, tile); // -1: there is no list
const float reach = *wp::address(lists.reach, list_group, tile);
const wp::vec4 bounds = *wp::address(lists.bounds, tile);
const auto& faces = lists.faces;
const auto& p_WC = view.p_WC;
const auto& q_WC = view.q_WC;
const uint64_t id = scene.mesh;

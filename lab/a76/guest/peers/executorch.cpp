// A policy that ExecuTorch exported, for a caller that speaks C: its runtime alone, as a rover in C++ would link it.
// Its Python binding needs torch beside it, whose memory would count as ExecuTorch's.

#include <executorch/extension/module/module.h>
#include <executorch/extension/tensor/tensor.h>
#include <executorch/extension/threadpool/threadpool_guard.h>

#include <cstring>
#include <memory>

using executorch::aten::ScalarType;
using executorch::extension::from_blob;
using executorch::extension::Module;
using executorch::extension::TensorPtr;
using executorch::extension::threadpool::NoThreadPoolGuard;

namespace {
struct Policy {
  NoThreadPoolGuard one_thread;  // before anything asks for a thread pool; it holds in the thread that loads
  std::unique_ptr<Module> module;
};
}  // namespace

extern "C" {

// A loaded policy, or null with *error set.
void* policy_load(const char* path, int* error) {
  auto policy = std::make_unique<Policy>();
  policy->module = std::make_unique<Module>(path, Module::LoadMode::File);
  *error = static_cast<int>(policy->module->load_forward());
  return *error ? nullptr : policy.release();
}

// Size of dimension `axis` of its first output, or -1.
int policy_output_size(void* loaded, int axis) {
  auto meta = static_cast<Policy*>(loaded)->module->method_meta("forward");
  if (!meta.ok()) return -1;
  auto output = meta->output_tensor_meta(0);
  return output.ok() && axis < static_cast<int>(output->sizes().size()) ? output->sizes()[axis] : -1;
}

// state: (1, states) float32, not given to a network if states is 0; frame: (1, 3, height, width) float32; chunk: room for the first output, float32.
// Returns 0, or ExecuTorch's error code.
int policy_run(void* loaded, float* state, int states, float* frame, int height, int width, float* chunk) {
  TensorPtr state_in = from_blob(state, {1, states}, ScalarType::Float);
  TensorPtr frame_in = from_blob(frame, {1, 3, height, width}, ScalarType::Float);
  Module& module = *static_cast<Policy*>(loaded)->module;
  auto outputs = states ? module.forward({state_in, frame_in}) : module.forward(frame_in);
  if (!outputs.ok()) return static_cast<int>(outputs.error());
  const auto& out = outputs->at(0).toTensor();
  std::memcpy(chunk, out.const_data_ptr<float>(), out.nbytes());
  return 0;
}
}

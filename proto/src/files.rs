//! iceoryx2 services that are made of files under the root and of nothing elsewhere: the mode of the folder above
//! decides who may take part, and nothing lies in `/dev/shm`. Stock clients cannot read them.

use core::fmt::Debug;

use iceoryx2::{
    prelude::ZeroCopySend,
    service::{Service as IoxService, internal::ServiceInternal},
    unique_id_generator::unique_system_id::UniqueSystemId,
};
use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_bb_lock_free::mpmc::counting_bit_set::RelocatableCountingBitSet;
use iceoryx2_cal::{
    arc_sync_policy, bag, dynamic_storage,
    event::trigger::{State, unix_datagram_socket::GenericUnixDatagramSocketTrigger},
    hash, monitoring, reactor, resizable_shared_memory, serialize, shared_memory,
    shm_allocator::{bump_allocator::BumpAllocator, pool_allocator::PoolAllocator},
    static_storage, zero_copy_connection,
};

/// Like iceoryx2's `ipc::Service`, with every storage in a file.
#[derive(Debug, Clone)]
pub struct Service {}

type Payload<Allocator> = shared_memory::file::Memory<Allocator>;

impl IoxService for Service {
    type StaticStorage = static_storage::recommended::Ipc;
    type ConfigSerializer = serialize::recommended::Recommended;
    type PersistentDynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> =
        dynamic_storage::file::Storage<T>;
    type Bag = bag::recommended::Recommended;
    type DynamicStorage<T: Debug + Send + Sync + ZeroCopySend + 'static> = dynamic_storage::file::Storage<T>;
    type ServiceNameHasher = hash::recommended::Recommended;
    type SharedMemory = Payload<PoolAllocator>;
    type ResizableSharedMemory =
        resizable_shared_memory::dynamic::DynamicMemory<PoolAllocator, Payload<PoolAllocator>>;
    type Connection = zero_copy_connection::file::Connection;
    type Event = GenericUnixDatagramSocketTrigger<
        RelocatableCountingBitSet,
        dynamic_storage::file::Storage<State<RelocatableCountingBitSet, ()>>,
    >;
    type Monitoring = monitoring::recommended::Ipc;
    type Reactor = reactor::recommended::Ipc;
    type ArcThreadSafetyPolicy<T: Send + Debug + Abandonable> =
        arc_sync_policy::single_threaded::SingleThreaded<T>;
    type BlackboardMgmt<K: Send + Sync + Debug + ZeroCopySend + 'static> = dynamic_storage::file::Storage<K>;
    type BlackboardPayload = Payload<BumpAllocator>;
    type UniqueId = UniqueSystemId;
}

impl ServiceInternal<Service> for Service {}

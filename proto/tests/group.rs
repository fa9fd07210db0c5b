//! Access by group within one process: which way a request came, and how a client finds its way.

mod common;

use std::time::Duration;

use common::Rig;
use grnet_proto::{
    Access, AccessMode, Command, ControlClient, ControlReply, ControlRequest, ControlServer, DaemonStatus,
    Group, Node, Outcome, PosePublisher, PoseSubscription, Role, Root, access::find,
};

const SOON: Duration = Duration::from_secs(5);

/// A root for members of this process's own group, with and without a folder for changes.
fn roots(rig: &Rig) -> (Root, Root) {
    let own = Group::of_id(rustix::process::getegid().as_raw());
    let root = Root::own(&rig.path.join("run"), None).unwrap();
    (root.clone().with_groups(None, Some(own)), root)
}

#[test]
fn a_client_finds_out_how_the_daemon_shares() {
    let rig = Rig::new();
    let (apart, plain) = roots(&rig);
    let node = Node::open(AccessMode::Group, &apart, Role::Daemon).unwrap();
    let mut publisher = PosePublisher::open(&node, &rig.camera).unwrap();
    let (access, found) = find(&rig.camera, &plain).unwrap();
    assert_eq!(access, AccessMode::Group);
    let client = Node::open(access, &found, Role::Client).unwrap();
    let subscription = PoseSubscription::open(&client, &rig.camera).unwrap();
    publisher.publish(&rig.sample(7)).unwrap();
    assert_eq!(subscription.receive().unwrap().unwrap().sequence, 7);
}

#[test]
fn a_request_that_went_round_the_folder_for_changes_is_known() {
    let rig = Rig::new();
    let (apart, plain) = roots(&rig);
    let (found, is_found) = std::sync::mpsc::channel();
    std::thread::scope(|scope| {
        let (rig, apart) = (&rig, &apart);
        scope.spawn(move || {
            let node = Node::open(AccessMode::Group, apart, Role::Daemon).unwrap();
            let _poses = PosePublisher::open(&node, &rig.camera).unwrap();
            let server = ControlServer::open(&node, &rig.camera).unwrap();
            found.send(find(&rig.camera, apart).unwrap()).unwrap();
            let mut answered = 0;
            while answered < 3 {
                while let Some(pending) = server.receive().unwrap() {
                    let way = if pending.may_change_state() { "by the folder" } else { "round it" };
                    let status = DaemonStatus::unknown(rig.boot_id, &rig.camera, Access::GROUP);
                    let reply = ControlReply::new(&pending.request(), Outcome::DONE, way, status);
                    pending.reply(&reply).unwrap();
                    answered += 1;
                }
                server.wait(SOON).unwrap();
            }
        });
        let (access, found) = is_found.recv().unwrap();
        let way = |root: &Root, command: Command| {
            let node = Node::open(access, root, Role::Client).unwrap();
            let mut client = ControlClient::open(&node, &rig.camera).unwrap();
            assert!(client.has_server());
            client.call(&ControlRequest::new(command), SOON).unwrap().message.to_string()
        };
        assert_eq!(way(&found, Command::RESET_ODOMETRY), "by the folder");
        assert_eq!(way(&found, Command::STATUS), "round it");
        assert_eq!(way(&plain, Command::RESET_ODOMETRY), "round it");
    });
}

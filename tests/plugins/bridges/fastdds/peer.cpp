// One topic by Fast DDS, which ROS 2 uses by default. Arguments: "read" or "write", domain, topic,
// number of messages. Reads: prints the sizes of the dimensions and the sum of the numbers of each.
// Writes: arrays of 4 x 6, message k with k + i / 100 in place i, once a reader is there.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <numeric>
#include <string>
#include <thread>

#include "Float32MultiArrayPubSubTypes.h"

using namespace eprosima::fastdds::dds;
using namespace std_msgs::msg::dds_;

static void read(DomainParticipant *participant, Topic *topic, int left)
{
    DataReaderQos quality;
    quality.reliability().kind = RELIABLE_RELIABILITY_QOS;
    quality.history().kind = KEEP_ALL_HISTORY_QOS;
    auto *subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    auto *reader = subscriber->create_datareader(topic, quality);
    Float32MultiArray_ message;
    SampleInfo info;
    while (left > 0) {
        reader->wait_for_unread_message(eprosima::fastrtps::Duration_t(1, 0));
        while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data)
                continue;
            for (const auto &one : message.layout().dim())
                std::printf("%s=%u ", one.label().c_str(), one.size());
            const auto &data = message.data();
            std::printf("%.4f\n", std::accumulate(data.begin(), data.end(), 0.0));
            std::fflush(stdout);
            left--;
        }
    }
}

static void write(DomainParticipant *participant, Topic *topic, int n)
{
    auto *publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    auto *writer = publisher->create_datawriter(topic, DATAWRITER_QOS_DEFAULT);
    PublicationMatchedStatus status;
    do {
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
        writer->get_publication_matched_status(status);
    } while (status.current_count == 0);
    for (int k = 0; k < n; k++) {
        Float32MultiArray_ message;
        for (auto side : {4u, 6u}) {
            MultiArrayDimension_ dimension;
            dimension.size(side);
            message.layout().dim().push_back(dimension);
        }
        for (int i = 0; i < 24; i++)
            message.data().push_back(k + i / 100.0f);
        writer->write(&message);
        std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
    writer->wait_for_acknowledgments(eprosima::fastrtps::Duration_t(10, 0));
}

int main(int, char **argv)
{
    auto *participant = DomainParticipantFactory::get_instance()->create_participant(
        static_cast<DomainId_t>(std::atoi(argv[2])), PARTICIPANT_QOS_DEFAULT);
    TypeSupport type(new Float32MultiArray_PubSubType());
    type.register_type(participant);
    auto *topic = participant->create_topic(argv[3], type.get_type_name(), TOPIC_QOS_DEFAULT);
    std::puts("READY");
    std::fflush(stdout);
    (std::string(argv[1]) == "read" ? read : write)(participant, topic, std::atoi(argv[4]));
}
